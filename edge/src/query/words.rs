//! The texts that requests have.

use schemars::JsonSchema;
use slag_service::params::RequestError;

use crate::text::MAX_TEXT_BYTES;

/// At most 512 bytes of UTF-8, without control characters.
#[derive(JsonSchema)]
#[schemars(rename = "Text")]
#[expect(dead_code, reason = "the schema of texts, which are read as strings and checked by `check_text`")]
pub struct Words(
    #[schemars(
        length(min = 1, max = MAX_TEXT_BYTES),
        regex(
            pattern = r"^[^\u0000-\u001f\u007f-\u009f]*[^\s\u0000-\u001f\u007f-\u009f][^\u0000-\u001f\u007f-\u009f]*$"
        )
    )]
    String,
);

/// Checks a text that the text model is to encode. `parameter`: its name, for the error.
pub fn check_text(parameter: &str, text: &str) -> Result<(), RequestError> {
    if text.len() > MAX_TEXT_BYTES {
        let found = format!("{} bytes", text.len());
        return Err(RequestError::new(parameter, &found, format!("at most {MAX_TEXT_BYTES} bytes")));
    }
    if text.trim().is_empty() {
        return Err(RequestError::new(parameter, text, "words to look for"));
    }
    if text.chars().any(|c| c.is_control() && !c.is_whitespace()) {
        return Err(RequestError::new(parameter, text, "no control characters"));
    }
    Ok(())
}
