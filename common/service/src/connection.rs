//! A connection's byte stream, with a progress deadline.

use std::io;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::time::{Instant, Sleep, sleep_until};

/// Bytes that count as progress if writes are taken in part.
const PROGRESS_BYTES: usize = 64 << 10;

/// A stream that fails once sending made no progress for `stall_timeout`.
///
/// One deadline bounds idle clients, slow requests and unread answers. Received bytes do not move it, so a request of
/// any length must arrive within it. A write taken whole is progress; of partial writes, every 64 KiB is, so that a
/// client that reads a byte at a time cannot hold its connection.
pub struct Stalling<S> {
    stream: S,
    stall_timeout: Duration,
    deadline: Pin<Box<Sleep>>,
    /// Bytes sent since the last progress.
    n_partial: usize,
}

impl<S> Stalling<S> {
    /// Wraps a stream; its first deadline starts now.
    pub fn new(stream: S, stall_timeout: Duration) -> Self {
        let deadline = Box::pin(sleep_until(Instant::now() + stall_timeout));
        Self { stream, stall_timeout, deadline, n_partial: 0 }
    }

    /// Turns `Pending` into an error after the deadline.
    fn bounded<T>(&mut self, polled: Poll<io::Result<T>>, context: &mut Context<'_>) -> Poll<io::Result<T>> {
        if polled.is_pending() {
            return self.deadline.as_mut().poll(context).map(|()| Err(io::ErrorKind::TimedOut.into()));
        }
        polled
    }

    /// As [`Stalling::bounded`], for a write of `offered` bytes, which moves the deadline if it is progress.
    fn sent(
        &mut self,
        polled: Poll<io::Result<usize>>,
        offered: usize,
        context: &mut Context<'_>,
    ) -> Poll<io::Result<usize>> {
        if let Poll::Ready(Ok(n)) = &polled {
            self.n_partial += n;
            if *n == offered || self.n_partial >= PROGRESS_BYTES {
                self.n_partial = 0;
                self.deadline.as_mut().reset(Instant::now() + self.stall_timeout);
            }
        }
        self.bounded(polled, context)
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for Stalling<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let polled = Pin::new(&mut self.stream).poll_read(context, buffer);
        self.bounded(polled, context)
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Stalling<S> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let polled = Pin::new(&mut self.stream).poll_write(context, bytes);
        self.sent(polled, bytes.len(), context)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let polled = Pin::new(&mut self.stream).poll_write_vectored(context, slices);
        self.sent(polled, slices.iter().map(|slice| slice.len()).sum(), context)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        let polled = Pin::new(&mut self.stream).poll_flush(context);
        self.bounded(polled, context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        let polled = Pin::new(&mut self.stream).poll_shutdown(context);
        self.bounded(polled, context)
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
    /// The attack: a reader of one byte at a time would hold its connection for ever.
    #[tokio::test]
    async fn a_reader_that_drips_is_dropped() {
        let (ours, mut theirs) = tokio::io::duplex(64);
        let mut connection = Stalling::new(ours, Duration::from_millis(200));
        let drip = tokio::spawn(async move {
            for _ in 0..100 {
                tokio::time::sleep(Duration::from_millis(20)).await;
                if theirs.read_u8().await.is_err() {
                    return;
                }
            }
        });
        let ended = connection.write_all(&[7; 4096]).await.expect_err("ends before the drip does");
        assert_eq!(ended.kind(), io::ErrorKind::TimedOut);
        drop(connection);
        drip.abort();
    }
}
