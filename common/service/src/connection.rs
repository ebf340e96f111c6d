//! A connection's byte stream, with a deadline for progress.

use std::io;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::time::{Instant, Sleep, sleep_until};

/// A stream that fails once nothing could be sent for `stall_timeout`.
///
/// Without a byte sent, a client idles, drips its request or does not read its answer: one deadline bounds
/// all three. Received bytes do not move the deadline, so a request of any length must arrive within it.
pub struct Stalling<S> {
    stream: S,
    stall_timeout: Duration,
    deadline: Pin<Box<Sleep>>,
}

impl<S> Stalling<S> {
    /// Wraps a stream; its first deadline begins now.
    pub fn new(stream: S, stall_timeout: Duration) -> Self {
        let deadline = Box::pin(sleep_until(Instant::now() + stall_timeout));
        Self { stream, stall_timeout, deadline }
    }

    /// Turns `Pending` into an error after the deadline; a sent byte moves the deadline.
    fn bounded<T>(
        &mut self,
        polled: Poll<io::Result<T>>,
        sending: bool,
        context: &mut Context<'_>,
    ) -> Poll<io::Result<T>> {
        if polled.is_pending() {
            return self.deadline.as_mut().poll(context).map(|()| Err(io::ErrorKind::TimedOut.into()));
        }
        if sending {
            self.deadline.as_mut().reset(Instant::now() + self.stall_timeout);
        }
        polled
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for Stalling<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let polled = Pin::new(&mut self.stream).poll_read(context, buffer);
        self.bounded(polled, false, context)
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Stalling<S> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let polled = Pin::new(&mut self.stream).poll_write(context, bytes);
        self.bounded(polled, true, context)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let polled = Pin::new(&mut self.stream).poll_write_vectored(context, slices);
        self.bounded(polled, true, context)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        let polled = Pin::new(&mut self.stream).poll_flush(context);
        self.bounded(polled, false, context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        let polled = Pin::new(&mut self.stream).poll_shutdown(context);
        self.bounded(polled, false, context)
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};

    use super::*;

    #[tokio::test]
    async fn sending_moves_the_deadline_and_receiving_does_not() {
        let (ours, mut theirs) = tokio::io::duplex(64);
        let mut connection = Stalling::new(ours, Duration::from_millis(200));
        for _ in 0..5 {
            tokio::time::sleep(Duration::from_millis(60)).await;
            connection.write_all(b"x").await.expect("room");
            let polled = tokio::time::timeout(Duration::ZERO, connection.read_u8()).await;
            assert!(polled.is_err(), "nothing to read yet, and no failure: {polled:?}");
        }
        let drip = tokio::spawn(async move {
            for _ in 0..100 {
                if theirs.write_all(b"y").await.is_err() {
                    return;
                }
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
        });
        let mut received = Vec::new();
        let ended = connection.read_to_end(&mut received).await.expect_err("ends before the drip does");
        assert_eq!(ended.kind(), io::ErrorKind::TimedOut);
        drop(connection);
        drip.await.expect("ends with the connection");
    }
}
