//! The node: its subscriptions, services and publications.

use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, anyhow};
use ros2_client::qos::{Durability, History, WhenFull};
use ros2_client::{
    Context, Message, MessageTypeName, Name, Node, NodeName, NodeOptions, Publisher, QosProfile,
    ServiceMapping, ServiceTypeName,
};
use rustdds::{DomainParticipantBuilder, Topic};
use serde::Serialize;
use serde_json::{Value, json};
use slag_robot::api::locate;
use slag_robot::{Answer, PointAnswer, Robot, RobotError};
use tokio::runtime::Handle;
use tokio::sync::oneshot;

use crate::answers;
use crate::args::{Args, Goals, Rmw, Source};
use crate::locator::{CameraFrames, Fixes, scene_from_optical};
use crate::messages::{
    CameraInfo, CompressedImage, Detection3DArray, FindReply, FindRequest, MarkerArray, NavSatFix,
    OccupancyGrid, Odometry, PointCloud2, PoseStamped, PoseWithCovariance, PoseWithCovarianceStamped,
    StandReply, StandRequest, Text, TransformStamped, Transforms as TransformMessages,
};
use crate::navigation::{ACCEPT_TIMEOUT, Ended, Navigator};
use crate::position;
use crate::stand;
use crate::transforms::Transforms;

/// Messages kept for late subscribers: the clouds of an answer.
const KEPT: usize = 4;
/// Longest pause for slow subscribers.
const WRITE_TIMEOUT: Duration = Duration::from_secs(2);
/// Longest wait for a cancelled goal to end: it must be accepted first.
const STOP_TIMEOUT: Duration = ACCEPT_TIMEOUT.saturating_add(Duration::from_secs(2));
/// Time for the last messages to leave the process.
const SEND_TIME: Duration = Duration::from_millis(500);
/// Interval of checks whether the robot's program answers, and of its objects on board.
const WATCH_PERIOD: Duration = Duration::from_secs(5);
/// Least time between two located photos.
const PHOTO_PERIOD: Duration = Duration::from_secs(2);
/// Pause after a failed read, so that a broken topic does not burn the CPU.
const READ_PAUSE: Duration = Duration::from_millis(100);

struct Shared {
    args: Args,
    robot: Robot,
    frames: Mutex<Transforms>,
    /// Robot's place in the scene, and time of the last post.
    place: Mutex<(Option<[f64; 3]>, Option<Instant>)>,
    /// Why the last position was not taken.
    not_taken: Mutex<Option<String>>,
    detections: Publisher<Detection3DArray>,
    objects: Publisher<Detection3DArray>,
    markers: Publisher<MarkerArray>,
    points: Publisher<PointCloud2>,
    best_pose: Publisher<PoseStamped>,
    goal: Publisher<PoseStamped>,
    ground: Publisher<OccupancyGrid>,
    goal_pose: Option<Publisher<PoseStamped>>,
    navigation: Option<Navigation>,
    locating: Option<Locating>,
}

struct Locating {
    camera: Mutex<Option<CameraInfo>>,
    fixes: Mutex<Fixes>,
    /// Time of the last photo accepted.
    last: Mutex<Option<Instant>>,
    pose: Publisher<PoseWithCovarianceStamped>,
    transforms: Publisher<TransformMessages>,
}

struct Navigation {
    navigator: Navigator,
    state: Publisher<Text>,
    /// Cancels the newest goal with a message, and ends with that goal.
    newest: Mutex<Option<(oneshot::Sender<()>, oneshot::Receiver<()>)>>,
}

impl Navigation {
    fn new(node: &mut Node, args: &Args, latest: &QosProfile) -> Result<Self> {
        let (volatile, name) = (reliable(10), args.own("navigation")?);
        Ok(Self {
            navigator: Navigator::new(node, args.mapping(), [&volatile, &volatile, latest])?,
            state: publisher(node, name, ("std_msgs", "String"), latest)?,
            newest: Mutex::default(),
        })
    }

    /// Cancels the newest goal, if it has not ended, and waits until that is sent.
    async fn stop(&self) {
        let newest = lock(&self.newest).take();
        if let Some((stop, ended)) = newest
            && stop.send(()).is_ok()
            && tokio::time::timeout(STOP_TIMEOUT, ended).await.is_err()
        {
            tracing::warn!("the goal may not be cancelled: Nav2 does not answer");
        }
    }
}

struct Found {
    answers: Vec<Answer>,
    points: Vec<PointAnswer>,
    /// Reason for no answers.
    reason: String,
}

pub async fn run(args: Args, robot: Robot, stop: impl Future<Output = ()>) -> Result<()> {
    let mut node = join(&args)?;
    let shared = Arc::new(Shared::new(&mut node, args, robot)?);
    shared.answer_asked(&mut node)?;
    shared.listen_to_robot(&mut node)?;
    let spinner = node.spinner().map_err(|e| anyhow!("cannot start the node: {e}"))?;
    tokio::spawn(spinner.spin());
    tracing::info!("/{} listens in domain {}", shared.args.name, shared.args.domain_id);
    tokio::spawn(Arc::clone(&shared).watch());
    stop.await;
    if let Some(navigation) = &shared.navigation {
        navigation.stop().await;
        // DDS sends in the background: a cancellation must not end with the process.
        tokio::time::sleep(SEND_TIME).await;
    }
    Ok(())
}

fn join(args: &Args) -> Result<Node> {
    let mut participant = DomainParticipantBuilder::new(args.domain_id);
    if !args.interfaces().is_empty() {
        participant = participant.with_only_networks(args.interfaces().iter().copied());
    }
    let joined = participant.build().map_err(|e| anyhow!("cannot join domain {}: {e}", args.domain_id))?;
    let context = Context::from_domain_participant(joined).map_err(|e| anyhow!("cannot start DDS: {e}"))?;
    let name =
        NodeName::new("/", &args.name).map_err(|e| anyhow!("{:?} is no name of a node: {e}", args.name))?;
    let node = context.new_node(name, NodeOptions::new().enable_rosout(true));
    node.map_err(|e| anyhow!("cannot make the node: {e:?}"))
}

impl Args {
    fn own(&self, topic: &str) -> Result<Name> {
        Ok(Name::new(&format!("/{}", self.name), topic)?)
    }

    fn mapping(&self) -> ServiceMapping {
        match self.rmw {
            Rmw::FastDds => ServiceMapping::Enhanced,
            Rmw::CycloneDds => ServiceMapping::Cyclone,
        }
    }
}

impl Shared {
    fn new(node: &mut Node, args: Args, robot: Robot) -> Result<Self> {
        // Latched with depth 1, as map_server's map: late subscribers would take an earlier answer for the last.
        let latest = reliable(1).durability(Durability::TransientLocal);
        let kept = reliable(KEPT).durability(Durability::TransientLocal);
        let now = reliable(1).durability(Durability::Volatile);
        let pose = ("geometry_msgs", "PoseStamped");
        let detections = ("vision_msgs", "Detection3DArray");
        let own = |topic: &str| args.own(topic);
        let goal_pose = match args.send_goals {
            Goals::Topic => Some(publisher(node, Name::new("/", "goal_pose")?, pose, &now)?),
            Goals::None | Goals::Action => None,
        };
        let navigation = match args.send_goals {
            Goals::Action => Some(Navigation::new(node, &args, &latest)?),
            Goals::None | Goals::Topic => None,
        };
        let locating = match args.camera {
            Some(_) => Some(Locating::new(node, own("pose")?, &latest)?),
            None => None,
        };
        Ok(Self {
            detections: publisher(node, own("detections")?, detections, &latest)?,
            objects: publisher(node, own("objects")?, detections, &latest)?,
            markers: publisher(node, own("markers")?, ("visualization_msgs", "MarkerArray"), &latest)?,
            points: publisher(node, own("points")?, ("sensor_msgs", "PointCloud2"), &kept)?,
            best_pose: publisher(node, own("best_pose")?, pose, &latest)?,
            goal: publisher(node, own("goal")?, pose, &latest)?,
            ground: publisher(node, own("ground")?, ("nav_msgs", "OccupancyGrid"), &latest)?,
            goal_pose,
            navigation,
            locating,
            frames: Mutex::default(),
            place: Mutex::default(),
            not_taken: Mutex::default(),
            robot,
            args,
        })
    }

    /// Subscribes to questions and offers services.
    fn answer_asked(self: &Arc<Self>, node: &mut Node) -> Result<()> {
        let (volatile, text) = (reliable(10), ("std_msgs", "String"));
        self.hear(node, self.args.own("query")?, text, &volatile, Self::publish_answers)?;
        self.hear(node, self.args.own("go_to")?, text, &volatile, Self::hear_wish)?;
        self.offer(node, "find", "Find", Self::find)?;
        self.offer(node, "stand", "Stand", Self::stand)
    }

    fn listen_to_robot(self: &Arc<Self>, node: &mut Node) -> Result<()> {
        let args = &self.args;
        let (sensor, latched) =
            (QosProfile::subscription_default(), reliable(100).durability(Durability::TransientLocal));
        if matches!(args.position, Source::Tf | Source::Odom) || args.camera.is_some() {
            for (topic, qos) in [("tf", &reliable(100)), ("tf_static", &latched)] {
                let kind = ("tf2_msgs", "TFMessage");
                self.hear(node, Name::new("/", topic)?, kind, qos, Self::hear_transforms)?;
            }
        }
        if let Some(camera) = &args.camera {
            let name = Name::new(camera, "camera_info")?;
            self.hear(node, name, ("sensor_msgs", "CameraInfo"), &sensor, Self::hear_camera)?;
            let name = Name::new(&format!("{camera}/image_rect"), "compressed")?;
            self.hear(node, name, ("sensor_msgs", "CompressedImage"), &sensor, Self::hear_photo)?;
        }
        match args.position {
            Source::Odom => {
                let (name, kind) = (Name::new("/", "odom")?, ("nav_msgs", "Odometry"));
                self.hear(node, name, kind, &sensor, Self::hear_odometry)
            }
            Source::Fix => {
                let (name, kind) = (Name::new("/", "fix")?, ("sensor_msgs", "NavSatFix"));
                self.hear(node, name, kind, &sensor, Self::hear_fix)
            }
            Source::Tf | Source::None => Ok(()),
        }
    }

    /// Subscribes to a topic, and handles its messages in sequence.
    fn hear<M: Message + Send + Sync + 'static, F: Future<Output = ()> + Send + 'static>(
        self: &Arc<Self>,
        node: &mut Node,
        name: Name,
        kind: (&str, &str),
        qos: &QosProfile,
        handle: impl Fn(Arc<Self>, M) -> F + Send + 'static,
    ) -> Result<()> {
        let topic = topic(node, &name, kind, qos)?;
        let told = node.create_subscription::<M>(&topic, None).map_err(|e| anyhow!("topic {name:?}: {e}"))?;
        let shared = Arc::clone(self);
        tokio::spawn(async move {
            loop {
                match told.async_take().await {
                    Ok((message, _)) => handle(Arc::clone(&shared), message).await,
                    Err(error) => {
                        tracing::warn!("a message cannot be read: {error}");
                        tokio::time::sleep(READ_PAUSE).await;
                    }
                }
            }
        });
        Ok(())
    }

    /// Offers a service, and answers its calls in sequence.
    fn offer<Q, R, F>(
        self: &Arc<Self>,
        node: &mut Node,
        name: &str,
        kind: &str,
        answer: impl Fn(Arc<Self>, Q) -> F + Send + 'static,
    ) -> Result<()>
    where
        Q: Message + Send + Sync + Clone + 'static,
        R: Message + Send + Sync + Clone + 'static,
        F: Future<Output = R> + Send + 'static,
    {
        let (mapping, kind, qos) =
            (self.args.mapping(), ServiceTypeName::new("slag_msgs", kind), reliable(10));
        let server = node.create_server::<Q, R>(mapping, &self.args.own(name)?, &kind, qos.clone(), qos);
        let server = server.map_err(|e| anyhow!("cannot offer {name}: {e}"))?;
        let shared = Arc::clone(self);
        tokio::spawn(async move {
            loop {
                let (id, request) = match server.async_receive_request().await {
                    Ok(received) => received,
                    Err(error) => {
                        tracing::warn!("a call cannot be read: {error}");
                        tokio::time::sleep(READ_PAUSE).await;
                        continue;
                    }
                };
                let reply = answer(Arc::clone(&shared), request).await;
                if let Err(error) = server.async_send_response(id, reply).await {
                    tracing::warn!("a reply cannot be sent: {error:?}");
                }
            }
        });
        Ok(())
    }

    /// Asks the robot's program off the async threads.
    async fn blocking<T: Send + 'static>(
        self: &Arc<Self>,
        ask: impl FnOnce(&Self) -> T + Send + 'static,
    ) -> Result<T, String> {
        let shared = Arc::clone(self);
        let asked = tokio::task::spawn_blocking(move || ask(&shared)).await;
        asked.map_err(|error| format!("slag-ros failed: {error}"))
    }

    /// Returns the robot's place in the scene, if known.
    fn place(&self) -> Option<[f64; 3]> {
        lock(&self.place).0
    }
}

fn lock<T>(of: &Mutex<T>) -> MutexGuard<'_, T> {
    of.lock().expect("no holder panics")
}

/// Returns the usual QoS of topics: reliable, keeping the last few messages.
fn reliable(depth: usize) -> QosProfile {
    QosProfile::publisher_default()
        .reliability_reliable(WhenFull::Wait(WRITE_TIMEOUT))
        .history(History::KeepLast { depth })
}

fn topic(node: &mut Node, name: &Name, (package, kind): (&str, &str), qos: &QosProfile) -> Result<Topic> {
    let topic = node.create_topic(name, MessageTypeName::new(package, kind), qos);
    topic.map_err(|e| anyhow!("{e}")).with_context(|| format!("topic {name:?}"))
}

fn publisher<M: Serialize>(
    node: &mut Node,
    name: Name,
    kind: (&str, &str),
    qos: &QosProfile,
) -> Result<Publisher<M>> {
    let topic = topic(node, &name, kind, qos)?;
    node.create_publisher(&topic, None).map_err(|e| anyhow!("topic {name:?}: {e}"))
}

impl Shared {
    async fn find(self: Arc<Self>, request: FindRequest) -> FindReply {
        let (text, header) = (request.text.clone(), answers::header(&self.args.scene_frame));
        let found = self.blocking(move |shared| shared.ask(&request, false)).await.flatten();
        let (answers, message) = match found {
            Ok(found) => (found.answers, found.reason),
            Err(message) => (Vec::new(), message),
        };
        let detections = answers::detections(&header, &text, &answers);
        FindReply { success: !answers.is_empty(), message, detections }
    }

    /// A place that was asked for is not a goal: nothing is sent to navigation.
    async fn stand(self: Arc<Self>, request: StandRequest) -> StandReply {
        let ask = move |shared: &Self| shared.args.stand(&shared.robot, &request.text, shared.place());
        stand::reply(&self.args.scene_frame, self.blocking(ask).await.flatten())
    }

    /// Sends the robot to a thing. Without a place to stand there, the goal of an earlier wish is outdated.
    async fn hear_wish(self: Arc<Self>, Text { data: text }: Text) {
        let Err(reason) = self.go(text.clone()).await else { return };
        tracing::warn!("{text:?}: {reason}");
        if let Some(navigation) = &self.navigation {
            navigation.stop().await;
            publish(&navigation.state, Text { data: format!("{text}: failed: {reason}") }).await;
        }
    }

    /// Publishes a place to stand near a thing and the ground on the way, or returns why there is none.
    async fn go(self: &Arc<Self>, text: String) -> Result<(), String> {
        let ground = self.blocking(|shared| shared.args.ground(&shared.robot, shared.place())).await??;
        if let Some(ground) = ground {
            publish(&self.ground, ground).await;
        }
        let reply = Arc::clone(self).stand(StandRequest { text: text.clone() }).await;
        if !reply.success {
            return Err(reply.message);
        }
        publish(&self.goal, reply.pose.clone()).await;
        if let Some(goal_pose) = &self.goal_pose {
            publish(goal_pose, reply.pose.clone()).await;
        }
        if let Some(navigation) = &self.navigation {
            // Nav2 may reject the new goal: the robot must not drive on to the old one.
            navigation.stop().await;
            let ((stop, stopped), (ended, has_ended)) = (oneshot::channel(), oneshot::channel());
            *lock(&navigation.newest) = Some((stop, has_ended));
            let (shared, tokio) = (Arc::clone(self), Handle::current());
            // The streams of an action are not Send, so its task has a thread.
            std::thread::spawn(move || {
                let _ended: oneshot::Sender<()> = ended;
                tokio.block_on(shared.drive(text, reply.pose, stopped));
            });
        }
        Ok(())
    }

    /// Sends a goal to Nav2 and publishes its progress and result.
    async fn drive(self: Arc<Self>, text: String, pose: PoseStamped, stop: oneshot::Receiver<()>) {
        let Some(Navigation { navigator, state, .. }) = &self.navigation else { return };
        let say = async |how: String| publish(state, Text { data: format!("{text}: {how}") }).await;
        let remaining = async |metres: f32| say(format!("{metres:.2} m remain")).await;
        match navigator.drive(pose, stop, remaining).await {
            Ok(Ended::Reached) => say("reached".into()).await,
            Ok(Ended::Cancelled) => say("cancelled".into()).await,
            Ok(Ended::Failed(reason)) | Err(reason) => {
                tracing::warn!("{text:?}: {reason}");
                say(format!("failed: {reason}")).await;
            }
        }
    }

    /// Publishes the objects on board whenever they change. Reports when the robot's program stops or starts
    /// answering: topics alone are silent then.
    async fn watch(self: Arc<Self>) {
        let (mut answered, mut on_board) = (None, None);
        loop {
            let listing = [("limit", answers::MAX_OBJECTS.to_string())];
            let asked = self.blocking(move |shared| shared.robot.objects(&listing)).await;
            let (listed, error) = match asked {
                Ok(Ok(page)) => (Some(page), None),
                Ok(Err(error @ RobotError::Unreachable { .. })) => (None, Some(error)),
                _ => (None, None),
            };
            if let Some(page) = listed
                && on_board.as_ref() != Some(&page)
            {
                let header = answers::header(&self.args.scene_frame);
                publish(&self.objects, answers::objects(&header, &page)).await;
                on_board = Some(page);
            }
            if answered != Some(error.is_none()) {
                match &error {
                    Some(error) => tracing::error!("{error}"),
                    None if answered.is_some() => tracing::info!("the robot's program answers again"),
                    None => {}
                }
                answered = Some(error.is_none());
            }
            tokio::time::sleep(WATCH_PERIOD).await;
        }
    }

    fn ask(&self, request: &FindRequest, with_points: bool) -> Result<Found, String> {
        let limit = if request.limit == 0 { self.args.limit } else { request.limit };
        let mut asked = json!({"texts": [request.text], "limit": limit});
        if let Some(place) = self.place() {
            asked["near"] = json!(place);
        }
        let reply = self.robot.ask(&asked).map_err(|e| e.to_string())?;
        let result = reply.results.into_iter().next().ok_or("the robot gave no result")?;
        let mut points = Vec::new();
        // A phrase has things, but no Gaussians of its own.
        if with_points && result.understood.is_none() && !result.answers.is_empty() {
            asked["limit"] = json!(self.args.points);
            let reply = self.robot.ask_points(&asked).map_err(|e| e.to_string())?;
            points = reply.results.into_iter().next().map(|result| result.answers).unwrap_or_default();
        }
        let reason = result.none.map(|none| none.detail).unwrap_or_default();
        Ok(Found { answers: result.answers, points, reason })
    }

    /// Answers a text on all topics. No match is an empty answer, which clears viewers.
    async fn publish_answers(self: Arc<Self>, Text { data: text }: Text) {
        let request = FindRequest { text: text.clone(), limit: 0 };
        let found = match self.blocking(move |shared| shared.ask(&request, true)).await.flatten() {
            Ok(found) => found,
            Err(error) => return tracing::warn!("{text:?}: {error}"),
        };
        if found.answers.is_empty() {
            tracing::info!("{text:?}: {}", found.reason);
        }
        let header = answers::header(&self.args.scene_frame);
        publish(&self.detections, answers::detections(&header, &text, &found.answers)).await;
        publish(&self.markers, answers::markers(&header, &text, &found.answers)).await;
        for cloud in answers::clouds(&header, &found.points) {
            publish(&self.points, cloud).await;
        }
        if let Some(pose) = answers::best_pose(&header, &found.answers) {
            publish(&self.best_pose, pose).await;
        }
    }

    async fn hear_transforms(self: Arc<Self>, told: TransformMessages) {
        let place = {
            let mut frames = lock(&self.frames);
            told.transforms.into_iter().for_each(|transform| frames.insert(transform));
            position::of_frame(&frames, &self.args.scene_frame, &self.args.base_frame)
        };
        if self.args.position == Source::Tf
            && let Some(place) = place
        {
            self.moved_to(place).await;
        }
    }

    async fn hear_odometry(self: Arc<Self>, told: Odometry) {
        let place = position::of_odometry(&lock(&self.frames), &self.args.scene_frame, &told);
        match place {
            Some(place) => self.moved_to(place).await,
            None => tracing::debug!("nothing connects {} to the scene", told.header.frame_id),
        }
    }

    async fn hear_fix(self: Arc<Self>, told: NavSatFix) {
        if let Some(place) = position::of_fix(&told)
            && self.is_due()
        {
            self.post(place).await;
        }
    }

    async fn hear_camera(self: Arc<Self>, told: CameraInfo) {
        if let Some(locating) = &self.locating {
            *lock(&locating.camera) = Some(told);
        }
    }

    /// Locates a photo, and publishes the robot's pose and the scene's place in odometry's frame.
    async fn hear_photo(self: Arc<Self>, photo: CompressedImage) {
        let Some(locating) = &self.locating else { return };
        let Some(camera) = locating.camera_of_due_photo() else { return };
        let Args { scene_frame, base_frame, fixed_frame, .. } = &self.args;
        let optical_frame = photo.header.frame_id.clone();
        let of_camera = CameraFrames::find(&lock(&self.frames), fixed_frame, &optical_frame, base_frame);
        let Some(of_camera) = of_camera else {
            return tracing::warn!(
                "nothing connects {optical_frame} with {fixed_frame} and {base_frame}: no photo is located"
            );
        };
        let header = answers::header(scene_frame);
        let parameters = of_camera.parameters(&camera);
        let asked = self.blocking(move |shared| shared.robot.locate(&parameters, &photo.data)).await;
        let pose = match asked {
            Ok(Ok(locate::Answer::Found(pose))) => pose,
            Ok(Ok(locate::Answer::Unsure { reason, .. } | locate::Answer::Lost { reason })) => {
                return tracing::info!("a photo is not located: {reason}");
            }
            Ok(Err(error)) => return tracing::warn!("a photo is not located: {error}"),
            Err(_) => return,
        };
        let Some(scene_from_optical) = scene_from_optical(&pose) else { return };
        let scene_from_base = scene_from_optical.after(of_camera.optical_from_base);
        let pose = PoseWithCovariance { pose: scene_from_base.pose(), covariance: covariance(&pose) };
        publish(&locating.pose, PoseWithCovarianceStamped { header, pose }).await;
        let CameraFrames { fixed_from_optical, optical_from_base } = of_camera;
        let fixed_from_scene = fixed_from_optical.after(scene_from_optical.inverse());
        let base_in_fixed = fixed_from_optical.after(optical_from_base).origin();
        let agreed = lock(&locating.fixes).add(fixed_from_scene, base_in_fixed);
        if let Some(fixed_from_scene) = agreed {
            let transform = TransformStamped {
                header: answers::header(fixed_frame),
                child_frame_id: scene_frame.clone(),
                translation: fixed_from_scene.origin().into(),
                rotation: fixed_from_scene.quaternion(),
            };
            lock(&self.frames).insert(transform.clone());
            publish(&locating.transforms, TransformMessages { transforms: vec![transform] }).await;
        }
    }

    async fn moved_to(self: Arc<Self>, [x, y, z]: [f64; 3]) {
        lock(&self.place).0 = Some([x, y, z]);
        if self.is_due() {
            self.post(json!({"x": x, "y": y, "z": z})).await;
        }
    }

    /// Returns whether a position may be posted, and if so restarts the interval.
    fn is_due(&self) -> bool {
        let (_, posted) = &mut *lock(&self.place);
        let is_due = posted.is_none_or(|posted| posted.elapsed() >= self.args.position_period);
        if is_due {
            *posted = Some(Instant::now());
        }
        is_due
    }

    async fn post(self: Arc<Self>, place: Value) {
        let Ok(posted) = self.blocking(move |shared| shared.robot.post_position(&place)).await else {
            return;
        };
        // Positions come ten times a second: a reason is told once.
        let reason = posted.err().map(|error| error.to_string());
        let before = std::mem::replace(&mut *lock(&self.not_taken), reason.clone());
        if let Some(reason) = reason.filter(|reason| before.as_ref() != Some(reason)) {
            tracing::warn!("the position is not taken: {reason}");
        }
    }
}

impl Locating {
    fn new(node: &mut Node, pose: Name, latest: &QosProfile) -> Result<Self> {
        let (tf, kind) = (Name::new("/", "tf")?, ("geometry_msgs", "PoseWithCovarianceStamped"));
        Ok(Self {
            camera: Mutex::default(),
            fixes: Mutex::default(),
            last: Mutex::default(),
            pose: publisher(node, pose, kind, latest)?,
            transforms: publisher(node, tf, ("tf2_msgs", "TFMessage"), &reliable(100))?,
        })
    }

    /// Returns the camera of a photo, if known and due; then restarts the interval.
    fn camera_of_due_photo(&self) -> Option<CameraInfo> {
        let camera = lock(&self.camera).clone()?;
        let mut last = lock(&self.last);
        let is_due = last.is_none_or(|last| last.elapsed() >= PHOTO_PERIOD);
        is_due.then(|| *last = Some(Instant::now()))?;
        Some(camera)
    }
}

/// Returns a pose's covariance in ROS order, the same as the robot's program's.
fn covariance(pose: &locate::Pose) -> [[f64; 6]; 6] {
    let at = |row: usize, column: usize| pose.covariance.get(6 * row + column).copied().unwrap_or(0.0);
    std::array::from_fn(|row| std::array::from_fn(|column| at(row, column)))
}

async fn publish<M: Serialize>(to: &Publisher<M>, message: M) {
    if let Err(error) = to.async_publish(message).await {
        tracing::warn!("a message cannot be published: {:?}", error.forget_data());
    }
}
