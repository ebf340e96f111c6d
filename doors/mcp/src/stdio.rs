//! Messages on standard input and output, a line each.

use std::io;
use std::sync::Arc;

use serde::de::IgnoredAny;
use serde_json::json;
use tokio::io::{
    AsyncBufRead, AsyncBufReadExt, AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt, BufReader,
    DuplexStream, duplex,
};
use tokio::sync::Mutex;
use tokio::task::JoinHandle;

/// Longest message; a longer one is no JSON. Far beyond the longest photo, which its tool refuses by name, however its
/// characters are escaped.
pub const MAX_LINE_BYTES: usize = 256 << 20;
const PIPE_BYTES: usize = 1 << 16;

/// What a server reads and writes; `written` ends when all that it wrote is on the output.
pub struct Ends {
    pub input: DuplexStream,
    pub output: DuplexStream,
    pub written: JoinHandle<io::Result<()>>,
}

/// Passes on lines of JSON. The library drops others unanswered, so they are answered here with an error of JSON-RPC
/// 2.0: no client waits for an answer to `NaN`.
pub fn answering<R, W>(input: R, output: W) -> Ends
where
    R: AsyncRead + Unpin + Send + 'static,
    W: AsyncWrite + Unpin + Send + 'static,
{
    let ((to_server, of_client), (to_client, of_server)) = (duplex(PIPE_BYTES), duplex(PIPE_BYTES));
    let output = Arc::new(Mutex::new(output));
    tokio::spawn(pass_on(BufReader::new(input), to_server, Arc::clone(&output)));
    let written = async move {
        let mut lines = BufReader::new(of_server);
        while let Some(line) = next_line(&mut lines).await? {
            write(&output, line).await?;
        }
        Ok(())
    };
    Ends { input: of_client, output: to_client, written: tokio::spawn(written) }
}

async fn pass_on(
    mut lines: impl AsyncBufRead + Unpin,
    mut to_server: DuplexStream,
    output: Arc<Mutex<impl AsyncWrite + Unpin>>,
) -> io::Result<()> {
    while let Some(mut line) = next_line(&mut lines).await? {
        match serde_json::from_slice::<IgnoredAny>(&line) {
            Err(error) if !line.trim_ascii().is_empty() => {
                let message = format!("the line is not JSON: {error}");
                let answer =
                    json!({"jsonrpc": "2.0", "id": null, "error": {"code": -32700, "message": message}});
                write(&output, answer.to_string().into_bytes()).await?;
            }
            _ => {
                line.push(b'\n');
                to_server.write_all(&line).await?;
            }
        }
    }
    Ok(())
}

async fn write(output: &Mutex<impl AsyncWrite + Unpin>, mut line: Vec<u8>) -> io::Result<()> {
    line.push(b'\n');
    let mut output = output.lock().await;
    output.write_all(&line).await?;
    output.flush().await
}

/// Returns the next line, without its end; `None` after the last one.
async fn next_line(lines: &mut (impl AsyncBufRead + Unpin)) -> io::Result<Option<Vec<u8>>> {
    let mut line = Vec::new();
    let n = lines.take(MAX_LINE_BYTES as u64).read_until(b'\n', &mut line).await?;
    line.pop_if(|last| *last == b'\n');
    Ok((n > 0).then_some(line))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// JSON-RPC 2.0, section 5.1: -32700, and `id` null, as it cannot be read.
    #[tokio::test]
    async fn a_line_that_is_no_json_is_answered() {
        let nested = "[".repeat(1000);
        let lines = format!("{{\"near\":[NaN,0,0]}}\n{{\"id\":1}}\n\n{nested}\n{{bad\n{{\"id\":2}}");
        let (mut of_output, output) = duplex(PIPE_BYTES);
        let ends = answering(io::Cursor::new(lines), output);
        let (mut input, mut passed) = (ends.input, String::new());
        input.read_to_string(&mut passed).await.expect("reads");
        assert_eq!(passed, "{\"id\":1}\n\n{\"id\":2}\n");
        let mut answers = ends.output;
        answers.write_all(b"{\"id\":1,\"result\":0}\n").await.expect("writes");
        drop(answers);
        ends.written.await.expect("ends").expect("writes");
        let mut written = String::new();
        of_output.read_to_string(&mut written).await.expect("reads");
        let written: Vec<serde_json::Value> =
            written.lines().map(|line| serde_json::from_str(line).expect("JSON")).collect();
        assert_eq!(written.len(), 4);
        for refused in &written[..3] {
            assert_eq!((&refused["id"], &refused["error"]["code"]), (&json!(null), &json!(-32700)));
        }
        assert_eq!(written[3]["result"], 0);
    }
}
