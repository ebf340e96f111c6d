//! Request and reply of `picture`.

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use rmcp::model::ContentBlock;
use rmcp::schemars::{self, JsonSchema};
use serde::Deserialize;
use slag_robot::{Robot, RobotError};

/// Which thing is shown.
#[derive(Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Shown {
    /// `id` of a thing that `find` or `list` gave.
    #[schemars(regex(pattern = "^o[0-9a-f]{16}$"))]
    pub id: String,
}

impl Shown {
    pub fn picture(&self, robot: &Robot) -> Result<ContentBlock, RobotError> {
        let jpeg = robot.thumbnail(&self.id)?;
        Ok(ContentBlock::image(BASE64_STANDARD.encode(jpeg), "image/jpeg"))
    }
}
