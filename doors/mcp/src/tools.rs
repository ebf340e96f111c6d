//! The tools.

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use rmcp::handler::server::router::tool::ToolRouter;
use rmcp::handler::server::wrapper::Parameters;
use rmcp::model::{ContentBlock, Implementation, ServerCapabilities, ServerConfig};
use rmcp::schemars::{self, JsonSchema};
use rmcp::{Json, ServerHandler, tool, tool_handler, tool_router};
use serde::Deserialize;
use slag_robot::Robot;

use crate::changes::{Compare, Difference};
use crate::find::{Found, Wanted};
use crate::list::{Listed, Listing};
use crate::locate::{Places, Seen};
use crate::place::{Asked, Description};
use crate::stand::{Going, Stands};

const INSTRUCTIONS: &str = "Answers where things are on the robot's map of its surroundings. All positions are in the \
    map's world frame and belong to the generation that the answer names. The map is a record of the past: things may \
    have moved since. Ask describe_place first if you do not know how large the map is, and list if you do not know what \
    is there; ask find for each thing, and where_to_stand before going to one. Names in a list are guesses, the \
    likeliest first.";

/// Which thing is shown.
#[derive(Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
struct Shown {
    /// `id` of a thing that `find` or `list` gave.
    #[schemars(regex(pattern = "^o[0-9a-f]{16}$"))]
    id: String,
}

#[derive(Clone, Debug)]
pub struct Tools {
    robot: Robot,
    router: ToolRouter<Self>,
}

#[tool_router(router = router)]
impl Tools {
    pub fn new(robot: Robot) -> Self {
        Self { robot, router: Self::router() }
    }

    /// Find things on the robot's map by words. Gives positions, sizes and how well each matches, best first; or
    /// why there is none.
    #[tool(annotations(title = "Find things", read_only_hint = true, open_world_hint = false))]
    async fn find(&self, Parameters(wanted): Parameters<Wanted>) -> Result<Json<Found>, String> {
        let request = wanted.request()?;
        self.blocking(move |robot| Found::new(robot.ask(&request).map_err(|e| e.to_string())?)).await
    }

    /// List the things on the robot's map with what they are probably called, the largest first or by name.
    #[tool(annotations(title = "What is here", read_only_hint = true, open_world_hint = false))]
    async fn list(&self, Parameters(listing): Parameters<Listing>) -> Result<Json<Listed>, String> {
        let parameters = listing.parameters()?;
        self.blocking(move |robot| robot.objects(&parameters).map(Listed::from)).await
    }

    /// Show a thing of the robot's map as the best photo of it has it. Some maps carry no pictures.
    #[tool(annotations(title = "Picture of a thing", read_only_hint = true, open_world_hint = false))]
    async fn picture(&self, Parameters(shown): Parameters<Shown>) -> Result<ContentBlock, String> {
        let Json(jpeg) = self.blocking(move |robot| robot.thumbnail(&shown.id)).await?;
        Ok(ContentBlock::image(BASE64_STANDARD.encode(jpeg), "image/jpeg"))
    }

    /// Find where the robot can stand near a thing: places that it reaches, has room at, and sees the thing from,
    /// best first; or why there is none. Where the map does not say which places are free, the answer is an error
    /// that says so.
    #[tool(annotations(title = "Where to stand", read_only_hint = true, open_world_hint = false))]
    async fn where_to_stand(&self, Parameters(going): Parameters<Going>) -> Result<Json<Stands>, String> {
        self.blocking(move |robot| robot.goal(&going.parameters()).map(Stands::from)).await
    }

    /// Find where the camera of a photo is on the robot's map, by landmarks; or why that cannot be told.
    #[tool(annotations(title = "Where am I", read_only_hint = true, open_world_hint = false))]
    async fn where_am_i(&self, Parameters(seen): Parameters<Seen>) -> Result<Json<Places>, String> {
        self.blocking(move |robot| seen.locate(robot)).await
    }

    /// Describe what the robot's map covers: its extent, age and gaps, and how many things match each of some
    /// words.
    #[tool(annotations(title = "Describe the place", read_only_hint = true, open_world_hint = false))]
    async fn describe_place(
        &self,
        Parameters(asked): Parameters<Asked>,
    ) -> Result<Json<Description>, String> {
        self.blocking(move |robot| asked.describe(robot)).await
    }

    /// Find what changed on the robot's map since an earlier state of it: things that appeared, went or moved.
    #[tool(annotations(title = "What changed", read_only_hint = true, open_world_hint = false))]
    async fn what_changed(
        &self,
        Parameters(compare): Parameters<Compare>,
    ) -> Result<Json<Difference>, String> {
        self.blocking(move |robot| robot.changes(&compare.parameters()).map(Difference::from)).await
    }

    async fn blocking<T: Send + 'static, E: ToString + Send + 'static>(
        &self,
        ask: impl FnOnce(&Robot) -> Result<T, E> + Send + 'static,
    ) -> Result<Json<T>, String> {
        let robot = self.robot.clone();
        let asked = tokio::task::spawn_blocking(move || ask(&robot)).await;
        let asked = asked.map_err(|error| format!("slag-mcp failed: {error}"))?;
        asked.map(Json).map_err(|error| error.to_string())
    }
}

#[tool_handler(router = self.router)]
impl ServerHandler for Tools {
    fn get_info(&self) -> ServerConfig {
        let program = Implementation::new("slag-mcp", env!("CARGO_PKG_VERSION"));
        ServerConfig::new(ServerCapabilities::builder().enable_tools().build())
            .with_server_info(program)
            .with_instructions(INSTRUCTIONS)
    }
}
