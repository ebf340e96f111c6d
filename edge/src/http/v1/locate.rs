//! `POST /v1/locate`: where the camera of a photo is.

use std::sync::Arc;

use axum::Json;
use axum::body::Bytes;
use axum::extract::State;
use axum::http::StatusCode;
use schemars::JsonSchema;
use serde::Deserialize;
use slag_locate::Prior;
use slag_service::params::Params;
use slag_service::problem::Problem;

use crate::http::app::App;
use crate::http::forms::{self, LatLonText, XyText, XyzText};
use crate::locate::{Answer, Camera, LocateError, PhotoFile, answer, map_working_bytes};
use crate::query::{Point, RequestError};
use crate::score::MAX_COORDINATE;

pub const PHOTOS: &[&str] = &["image/jpeg", "image/png", "image/webp"];

/// The photo's camera, without lens distortion.
#[derive(Deserialize, JsonSchema)]
#[schemars(inline)]
pub struct LocateParams {
    /// Focal length, pixels of the photo.
    #[schemars(range(min = 1, max = MAX_COORDINATE), example = 554.3)]
    focal_px: f64,
    /// Principal point, pixels from the left and the top; by default the middle of the photo.
    #[schemars(example = &"320,240")]
    centre_px: Option<XyText>,
    /// Direction of gravity in the camera's frame (x right, y down, z forward), opposite to what an accelerometer at rest
    /// measures: poses that contradict it are refused.
    #[schemars(example = &"0,1,0")]
    gravity: Option<XyzText>,
    /// With sigma: where the robot may be; poses elsewhere are refused.
    #[schemars(example = &"2,1.5,0")]
    near: Option<XyzText>,
    /// The same on the earth, WGS 84: lat,lon or lat,lon,height.
    #[schemars(example = &"46.8,-92.1")]
    near_lat_lon: Option<LatLonText>,
    /// Standard deviation of near, world units: poses beyond three of it are refused.
    #[schemars(extend("exclusiveMinimum" = 0, "maximum" = MAX_COORDINATE), example = 5)]
    sigma: Option<f64>,
}

impl LocateParams {
    /// Returns the camera, and its prior position with standard deviation.
    fn camera(self) -> Result<(Camera, Option<(Point, f64)>), RequestError> {
        let focal_px = self.focal_px;
        if !(1.0..=MAX_COORDINATE).contains(&focal_px) {
            return Err(RequestError::new("focal_px", &focal_px.to_string(), "pixels, 1 or more"));
        }
        let near = match (forms::point(self.near, self.near_lat_lon)?, self.sigma) {
            (None, None) => None,
            (Some(near), Some(sigma)) if sigma > 0.0 && sigma <= MAX_COORDINATE => Some((near, sigma)),
            (Some(_), sigma) => {
                let found = sigma.map_or("nothing".into(), |sigma| sigma.to_string());
                return Err(RequestError::new("sigma", &found, "more than 0, because there is near"));
            }
            (None, Some(_)) => return Err(RequestError::new("near", "nothing", "x,y,z, because of sigma")),
        };
        let camera = Camera {
            focal_px,
            centre_px: self.centre_px.map(|XyText(centre)| centre),
            gravity: self.gravity.map(|XyzText(gravity)| gravity),
            prior: None,
        };
        Ok((camera, near))
    }
}

pub async fn locate(
    State(app): State<Arc<App>>,
    Params(params): Params<LocateParams>,
    photo: Bytes,
) -> Result<Json<Answer>, Problem> {
    let (mut camera, near) = params.camera()?;
    app.within_limits(None, move |app, budget| {
        let snapshot = app.engine.snapshot()?;
        if let Some((near, sigma)) = near {
            let position_in_world = near.in_world("near", &snapshot.manifest)?;
            camera.prior = Some(Prior { position_in_world, sigma });
        }
        budget.take(PhotoFile::opening_bytes(&photo));
        budget.check()?;
        let opened = PhotoFile::open(&photo).map_err(problem)?;
        budget.take(opened.working_bytes() + map_working_bytes(&snapshot));
        budget.check()?;
        answer(&snapshot, opened, &camera, budget).map(Json).map_err(problem)
    })
    .await
}

fn problem(error: LocateError) -> Problem {
    match error {
        LocateError::Version { .. } => {
            Problem::new(StatusCode::CONFLICT, "landmarks-version", "Landmarks do not fit", error.to_string())
        }
        LocateError::Camera(error) => error.into(),
        LocateError::Photo(what) => Problem::new(StatusCode::BAD_REQUEST, "bad-photo", "Bad photo", what),
    }
}
