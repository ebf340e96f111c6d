//! Nav2's action `NavigateToPose`: sends a place to stand as a goal, and reports progress and result.

use std::time::Duration;

use anyhow::{Result, anyhow};
use ros2_client::action::{ActionClient, ActionClientQosPolicies, GoalId, GoalStatusEnum};
use ros2_client::{ActionTypeName, Name, Node, QosProfile, RmwRequestId, ServiceMapping};
use tokio::sync::oneshot;
use tokio::time::timeout;

use crate::messages::{NavigationFeedback, NavigationGoal, NavigationResult, PoseStamped};

/// Longest wait for the server to accept a goal.
pub const ACCEPT_TIMEOUT: Duration = Duration::from_secs(10);

pub enum Ended {
    Reached,
    Cancelled,
    /// Nav2 gave up, for this reason.
    Failed(String),
}

pub struct Navigator {
    client: ActionClient<NavigationGoal, NavigationResult, NavigationFeedback>,
}

impl Navigator {
    /// Makes the client of `/navigate_to_pose`. `service`, `topic`, `latched`: QoS of services, feedback and status.
    pub fn new(
        node: &mut Node,
        mapping: ServiceMapping,
        [service, topic, latched]: [&QosProfile; 3],
    ) -> Result<Self> {
        let qos = ActionClientQosPolicies {
            goal_service: service.clone(),
            result_service: service.clone(),
            cancel_service: service.clone(),
            feedback_subscription: topic.clone(),
            status_subscription: latched.clone(),
        };
        let kind = ActionTypeName::new("nav2_msgs", "NavigateToPose");
        let client = node.create_action_client(mapping, &Name::new("/", "navigate_to_pose")?, &kind, qos);
        Ok(Self { client: client.map_err(|e| anyhow!("cannot use the action navigate_to_pose: {e}"))? })
    }

    /// Sends a goal, reports the remaining distances, in metres, and returns its result. `stop` cancels the goal, as
    /// does anything that leaves its result unknown.
    pub async fn drive(
        &self,
        pose: PoseStamped,
        stop: oneshot::Receiver<()>,
        remaining: impl AsyncFnMut(f32),
    ) -> Result<Ended, String> {
        let goal = NavigationGoal { pose, behavior_tree: String::new() };
        let (request, id) =
            self.client.send_goal(goal).map_err(|e| format!("the goal cannot be sent: {e:?}"))?;
        let followed = async {
            // Nav2 refuses to cancel a goal before accepting it.
            if !self.is_accepted(request).await? {
                return Ok(Ended::Failed("Nav2 rejects the goal".into()));
            }
            tokio::select! {
                _ = stop => Ok(Ended::Cancelled),
                ended = self.follow(id, remaining) => ended,
            }
        };
        let followed = followed.await;
        if matches!(followed, Err(_) | Ok(Ended::Cancelled)) {
            let cancelled = self.client.cancel_goal(id);
            cancelled.map_err(|e| format!("the goal cannot be cancelled: {e:?}"))?;
        }
        followed
    }

    async fn is_accepted(&self, request: RmwRequestId) -> Result<bool, String> {
        let answered = self.client.goal_client().async_receive_response(request);
        let answered = timeout(ACCEPT_TIMEOUT, answered).await;
        let answered =
            answered.map_err(|_| "no server of /navigate_to_pose takes goals; is Nav2 running?")?;
        answered.map(|answer| answer.accepted).map_err(|e| format!("Nav2's answer cannot be read: {e:?}"))
    }

    async fn follow(&self, id: GoalId, mut remaining: impl AsyncFnMut(f32)) -> Result<Ended, String> {
        let mut ended = std::pin::pin!(self.client.async_request_result(id));
        let (status, result) = loop {
            tokio::select! {
                ended = &mut ended => break ended.map_err(|e| format!("the result cannot be read: {e:?}"))?,
                told = self.client.feedback_subscription().async_take() => match told {
                    Ok((told, _)) if told.goal_id == id => remaining(told.feedback.distance_remaining).await,
                    Ok(_) => {}
                    Err(error) => return Err(format!("the feedback cannot be read: {error}")),
                },
            }
        };
        Ok(match status {
            GoalStatusEnum::Succeeded => Ended::Reached,
            status => Ended::Failed(format!("Nav2 ends the goal: {status:?}{}", result.reason())),
        })
    }
}

impl NavigationResult {
    #[cfg(feature = "jazzy")]
    fn reason(&self) -> String {
        format!(", error code {}", self.error_code)
    }

    /// Humble gives no reason.
    #[cfg(not(feature = "jazzy"))]
    fn reason(&self) -> String {
        String::new()
    }
}
