//! Nav2's action `NavigateToPose`: a place to stand as a goal, its progress, and how it ended.

use std::time::Duration;

use anyhow::{Result, anyhow};
use ros2_client::action::{ActionClient, ActionClientQosPolicies, GoalStatusEnum};
use ros2_client::{ActionTypeName, Name, Node, QosProfile, ServiceMapping};
use tokio::sync::oneshot;
use tokio::time::timeout;

use crate::messages::{NavigationFeedback, NavigationGoal, NavigationResult, PoseStamped};

/// Longest wait for the server to take a goal.
const ACCEPT_TIMEOUT: Duration = Duration::from_secs(10);

pub enum Ended {
    Reached,
    Cancelled,
    /// Another goal took its place.
    Replaced,
}

pub struct Navigator {
    client: ActionClient<NavigationGoal, NavigationResult, NavigationFeedback>,
}

impl Navigator {
    /// Makes the client of `/navigate_to_pose`. `service`, `topic`, `latched`: quality of the action's services,
    /// of its feedback, and of its status.
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

    /// Sends a goal, hands on the distances that remain, in metres, and returns how it ended. A message of `stop`
    /// cancels the goal; its end alone means that another goal takes its place, for which Nav2 gives this one up.
    pub async fn drive(
        &self,
        pose: PoseStamped,
        mut stop: oneshot::Receiver<()>,
        mut remaining: impl AsyncFnMut(f32),
    ) -> Result<Ended, String> {
        let goal = NavigationGoal { pose, behavior_tree: String::new() };
        let sent = timeout(ACCEPT_TIMEOUT, self.client.async_send_goal(goal)).await;
        let sent = sent.map_err(|_| "no server of /navigate_to_pose takes goals; is Nav2 running?")?;
        let (id, response) = sent.map_err(|e| format!("the goal cannot be sent: {e:?}"))?;
        if !response.accepted {
            return Err("Nav2 rejects the goal".into());
        }
        let ended = self.client.async_request_result(id);
        let mut ended = std::pin::pin!(ended);
        let (status, result) = loop {
            tokio::select! {
                told = &mut stop => {
                    if told.is_err() {
                        return Ok(Ended::Replaced);
                    }
                    let cancelled = self.client.cancel_goal(id);
                    cancelled.map_err(|e| format!("the goal cannot be cancelled: {e:?}"))?;
                    return Ok(Ended::Cancelled);
                }
                ended = &mut ended => break ended.map_err(|e| format!("the result cannot be read: {e:?}"))?,
                told = self.client.feedback_subscription().async_take() => match told {
                    Ok((told, _)) if told.goal_id == id => remaining(told.feedback.distance_remaining).await,
                    Ok(_) => {}
                    Err(error) => return Err(format!("the feedback cannot be read: {error}")),
                },
            }
        };
        match status {
            GoalStatusEnum::Succeeded => Ok(Ended::Reached),
            status => Err(format!("Nav2 ends the goal: {status:?}{}", result.reason())),
        }
    }
}

impl NavigationResult {
    /// Returns the reason that the distribution gives.
    #[cfg(feature = "jazzy")]
    fn reason(&self) -> String {
        format!(", error code {}", self.error_code)
    }

    /// Returns the reason that the distribution gives: Humble gives none.
    #[cfg(not(feature = "jazzy"))]
    fn reason(&self) -> String {
        String::new()
    }
}
