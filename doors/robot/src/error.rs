//! Errors of a robot's replies.

use serde_json::Value;

#[derive(Debug, thiserror::Error)]
pub enum RobotError {
    #[error(
        "{url} does not answer: {cause}; start `slag-edge serve` there, or give its address with --robot"
    )]
    Unreachable { url: String, cause: Box<ureq::Error> },
    /// It was not asked, it refused, or what answered is no robot: why, and what to do.
    #[error("{0}")]
    Refused(String),
}

impl RobotError {
    /// Parses a refusal: problem details (RFC 9457), or the start of any other text.
    pub(crate) fn refused(status: u16, body: &str) -> Self {
        let problem: Option<Value> = serde_json::from_str(body).ok();
        let detail = problem.as_ref().and_then(|problem| problem["detail"].as_str());
        let mut detail = detail.map_or_else(|| body.chars().take(200).collect(), str::to_owned);
        // All paths asked for are there.
        let is_other = |problem: &Value| problem["type"] == "urn:slag:problem:not-found";
        if status == 405 || problem.as_ref().is_some_and(is_other) {
            detail += "; see that --robot names a slag-edge of this version, not a store";
        }
        Self::Refused(format!("the robot refused ({status}): {detail}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refusal_says_what_the_robot_said() {
        let told = |status, body: &str| RobotError::refused(status, body).to_string();
        let problem = r#"{"type": "bad-parameter", "detail": "limit is 0, expected 1 to 10000"}"#;
        assert_eq!(told(400, problem), "the robot refused (400): limit is 0, expected 1 to 10000");
        let store = r#"{"type": "urn:slag:problem:not-found", "detail": "there is nothing at \"/v1/map\""}"#;
        assert!(told(404, store).ends_with("not a store"), "{}", told(404, store));
        assert_eq!(told(502, "Bad gateway"), "the robot refused (502): Bad gateway");
        assert_eq!(told(500, &"x".repeat(9999)).len(), "the robot refused (500): ".len() + 200);
    }
}
