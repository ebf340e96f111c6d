//! A client of the robot, and the flags of every door that select it.

use std::io;
use std::net::IpAddr;
use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use serde::de::DeserializeOwned;
use serde_json::{Value, json};
use slag_api::changes::ChangesReply;
use slag_api::floor::Floor;
use slag_api::goal::GoalReply;
use slag_api::locate;
use slag_api::map::MapStatus;
use slag_api::objects::ObjectPage;
use slag_common::files;
use ureq::http::Uri;

use crate::error::RobotError;
use crate::reply::{PointAnswer, Reply};

/// Longest reply read: ten thousand answers are 10 MB.
const MAX_REPLY_BYTES: u64 = 64 << 20;
/// Longest text that a robot takes.
const MAX_TEXT_BYTES: usize = 512;
/// Most characters of an invalid id in an error.
const MAX_ID_CHARS: usize = 40;
const TIMEOUT: Duration = Duration::from_secs(20);

/// More than any token that a robot accepts.
const MAX_TOKEN_BYTES: u64 = 8192;

type Response = Result<ureq::http::Response<ureq::Body>, ureq::Error>;

/// The robot to ask.
#[derive(Clone, Debug, Args)]
pub struct RobotArgs {
    /// Address of the robot's `slag-edge serve`.
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:7734", env = "SLAG_ROBOT", value_parser = address)]
    robot: String,
    /// File with the token of the robot's --token-file.
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
}

fn address(text: &str) -> Result<String, &'static str> {
    let url = text.parse::<Uri>().ok().filter(|url| matches!(url.scheme_str(), Some("http" | "https")));
    url.and_then(|url| url.host().map(|_| text.to_owned()))
        .ok_or("expected http://HOST:PORT or https://HOST:PORT")
}

impl RobotArgs {
    /// Returns the robot, with the file's token; sends nothing.
    pub fn open(&self) -> io::Result<Robot> {
        let read = |path: &PathBuf| io::read_to_string(&files::read_short(path, MAX_TOKEN_BYTES)?[..]);
        let token = self.token_file.as_ref().map(read).transpose()?;
        Ok(Robot::new(&self.robot, token.as_deref().map(str::trim)))
    }
}

/// A robot's `slag-edge serve`. Calls block.
#[derive(Clone, Debug)]
pub struct Robot {
    agent: ureq::Agent,
    url: String,
    /// The header of requests with a body.
    authorization: Option<String>,
}

impl Robot {
    /// Takes a robot's address, and the token of its `--token-file`, if any; sends nothing.
    pub fn new(url: &str, token: Option<&str>) -> Self {
        let mut config =
            ureq::Agent::config_builder().timeout_global(Some(TIMEOUT)).http_status_as_error(false);
        if is_loopback(url) {
            // A proxy of the environment would take the request, and the token, to another machine.
            config = config.proxy(None);
        }
        Self {
            agent: config.build().into(),
            url: url.trim_end_matches('/').to_owned(),
            authorization: token.map(|token| format!("Bearer {token}")),
        }
    }

    /// Posts a request to `/v1/query`.
    pub fn ask(&self, request: &Value) -> Result<Reply, RobotError> {
        self.ask_for(request)
    }

    /// As [`Self::ask`], for matching Gaussians.
    pub fn ask_points(&self, request: &Value) -> Result<Reply<PointAnswer>, RobotError> {
        let mut request = request.clone();
        request["kind"] = json!("gaussians");
        self.ask_for(&request)
    }

    fn ask_for<A: DeserializeOwned>(&self, request: &Value) -> Result<Reply<A>, RobotError> {
        check_texts(request["texts"].as_array().into_iter().flatten().filter_map(Value::as_str))?;
        self.post("/v1/query", request)
    }

    pub fn place(&self) -> Result<MapStatus, RobotError> {
        self.get("/v1/map", &[])
    }

    pub fn objects(&self, parameters: &[(&str, String)]) -> Result<ObjectPage, RobotError> {
        self.get("/v1/objects", parameters)
    }

    /// Returns the number of things on board, or in a ball.
    pub fn n_objects(&self, ball: Option<([f64; 3], f64)>) -> Result<usize, RobotError> {
        let mut parameters = vec![("limit", "1".to_owned())];
        if let Some((centre, radius)) = ball {
            parameters.extend([("near", xyz(centre)), ("radius", radius.to_string())]);
        }
        Ok(self.objects(&parameters)?.n_objects)
    }

    /// Returns the thumbnail of a thing, a JPEG file.
    pub fn thumbnail(&self, id: &str) -> Result<Vec<u8>, RobotError> {
        if !id.bytes().all(|byte| byte.is_ascii_alphanumeric()) {
            let id: String = id.chars().take(MAX_ID_CHARS).collect();
            let advice = "give one that the robot named, such as o00d1f3a5b7c9e0d2";
            return Err(RobotError::Refused(format!("{id:?} is no id of a thing; {advice}")));
        }
        let path = format!("/v1/objects/{id}/thumbnail");
        let body = self.read_bytes(&path, self.agent.get(self.address(&path)).call())?;
        if !body.starts_with(&[0xff, 0xd8]) {
            let advice = "does --robot name a slag-edge of this version?";
            return Err(RobotError::Refused(format!("the picture of {id} is no JPEG file; {advice}")));
        }
        Ok(body)
    }

    pub fn goal(&self, parameters: &[(&str, String)]) -> Result<GoalReply, RobotError> {
        self.get("/v1/goal", parameters)
    }

    pub fn changes(&self, parameters: &[(&str, String)]) -> Result<ChangesReply, RobotError> {
        self.get("/v1/changes", parameters)
    }

    pub fn floor(&self, parameters: &[(&str, String)]) -> Result<Floor, RobotError> {
        self.get("/v1/floor", parameters)
    }

    pub fn locate(&self, parameters: &[(&str, String)], photo: &[u8]) -> Result<locate::Answer, RobotError> {
        let media_type = match photo {
            [0x89, b'P', b'N', b'G', ..] => "image/png",
            [b'R', b'I', b'F', b'F', ..] => "image/webp",
            _ => "image/jpeg",
        };
        self.send("/v1/locate", parameters, media_type, photo)
    }

    /// Posts the robot's position to `/position`; a following robot then fetches its surroundings.
    ///
    /// # Errors
    /// [`RobotError`]; one that does not follow refuses.
    pub fn post_position(&self, position: &Value) -> Result<(), RobotError> {
        self.post::<Value>("/position", position).map(drop)
    }

    fn get<T: DeserializeOwned>(&self, path: &str, parameters: &[(&str, String)]) -> Result<T, RobotError> {
        let pairs = || parameters.iter().map(|(name, value)| (*name, value.as_str()));
        check_texts(pairs().filter_map(|(name, value)| (name == "text").then_some(value)))?;
        self.read(path, self.agent.get(self.address(path)).query_pairs(pairs()).call())
    }

    fn post<T: DeserializeOwned>(&self, path: &str, body: &Value) -> Result<T, RobotError> {
        self.send(path, &[], "application/json", body.to_string().as_bytes())
    }

    fn send<T: DeserializeOwned>(
        &self,
        path: &str,
        parameters: &[(&str, String)],
        media_type: &str,
        body: &[u8],
    ) -> Result<T, RobotError> {
        let pairs = parameters.iter().map(|(name, value)| (*name, value.as_str()));
        let request = self.agent.post(self.address(path)).query_pairs(pairs);
        let mut request = request.header("content-type", media_type);
        if let Some(authorization) = &self.authorization {
            request = request.header("authorization", authorization);
        }
        self.read(path, request.send(body))
    }

    fn read<T: DeserializeOwned>(&self, path: &str, response: Response) -> Result<T, RobotError> {
        let body = self.read_bytes(path, response)?;
        serde_json::from_slice(&body).map_err(|cause| {
            let (url, advice) = (self.address(path), "see that --robot names a slag-edge of this version");
            RobotError::Refused(format!("{url} answers, but not as slag-edge does: {cause}; {advice}"))
        })
    }

    fn read_bytes(&self, path: &str, response: Response) -> Result<Vec<u8>, RobotError> {
        let unreachable = |cause| RobotError::Unreachable { url: self.address(path), cause: Box::new(cause) };
        let mut response = response.map_err(unreachable)?;
        let body = response.body_mut().with_config().limit(MAX_REPLY_BYTES).read_to_vec();
        let (status, body) = (response.status(), body.map_err(unreachable)?);
        if !status.is_success() {
            return Err(RobotError::refused(status.as_u16(), &String::from_utf8_lossy(&body)));
        }
        Ok(body)
    }

    fn address(&self, path: &str) -> String {
        format!("{}{path}", self.url)
    }
}

/// Formats a point as parameters do.
pub fn xyz([x, y, z]: [f64; 3]) -> String {
    format!("{x},{y},{z}")
}

fn is_loopback(url: &str) -> bool {
    let Ok(uri) = url.parse::<Uri>() else { return false };
    let host = uri.host().unwrap_or_default().trim_start_matches('[').trim_end_matches(']');
    // The unspecified address reaches this machine.
    let is_here = |ip: IpAddr| ip.to_canonical().is_loopback() || ip.is_unspecified();
    host.eq_ignore_ascii_case("localhost") || host.parse().is_ok_and(is_here)
}

/// Refuses overlong texts already here: doors use their own token, on behalf of anybody.
fn check_texts<'a>(mut texts: impl Iterator<Item = &'a str>) -> Result<(), RobotError> {
    match texts.find(|text| text.len() > MAX_TEXT_BYTES) {
        Some(text) => Err(RobotError::Refused(format!(
            "a text has {} bytes, expected at most {MAX_TEXT_BYTES}; name the thing in a few words",
            text.len()
        ))),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn this_machine_is_asked_without_a_proxy() {
        let here = "http://127.0.0.1:7734 http://localhost:1/ https://[::1]:7 http://LOCALHOST http://127.9.9.9 \
                    http://0.0.0.0:7734 http://[::ffff:127.0.0.1]:7734";
        let there = "http://10.0.0.1:7734 http://localhost.example:1 http://robot no-url http://[fe80::1] \
                     http://[::ffff:10.0.0.1]";
        for (urls, expected) in [(here, true), (there, false)] {
            assert!(urls.split_whitespace().all(|url| is_loopback(url) == expected), "{urls}");
        }
    }

    /// In a separate process, with a proxy in its environment.
    #[test]
    fn a_proxy_of_the_environment_is_for_other_machines() {
        const PROXY: &str = "http://192.0.2.1:3128";
        if std::env::var("HTTP_PROXY").as_deref() != Ok(PROXY) {
            let name = "client::tests::a_proxy_of_the_environment_is_for_other_machines";
            let mut again = std::process::Command::new(std::env::current_exe().expect("this program"));
            let run = again.args(["--exact", name]).env("HTTP_PROXY", PROXY).output().expect("starts");
            let said = String::from_utf8_lossy(&run.stdout);
            assert!(run.status.success() && said.contains("1 passed"), "{said}");
            return;
        }
        let has_proxy = |url| Robot::new(url, None).agent.config().proxy().is_some();
        assert_eq!([has_proxy("http://127.0.0.1:7734"), has_proxy("http://10.0.0.1:7734")], [false, true]);
    }

    /// Without a listener: an overlong text is refused before anything is sent.
    #[test]
    fn long_texts_are_not_sent() {
        let robot = Robot::new("http://127.0.0.1:9", None);
        let long = "a on ".repeat(9_000);
        let refused = [
            robot.ask(&json!({"texts": ["chair", long]})).map(drop),
            robot.ask_points(&json!({"texts": [long]})).map(drop),
            robot.goal(&[("text", long.clone())]).map(drop),
            robot.changes(&[("text", long)]).map(drop),
        ];
        for refused in refused {
            assert!(refused.expect_err("too long").to_string().starts_with("a text has 45000 bytes"));
        }
    }
}
