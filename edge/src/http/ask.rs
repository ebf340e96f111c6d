//! The parameters of `/v1/query` and of `/query`; the engine's names of refused parts, translated for clients.

use axum::extract::Request;
use axum::http::HeaderMap;
use axum::middleware::Next;
use axum::response::Response;
use schemars::JsonSchema;
use serde::Deserialize;
use slag_service::problem::Problem;

use super::forms::{self, AreaParams, LatLonText, NegativesText, XyzText};
use crate::query::{
    AnswerKind, Ask, DEFAULT_LIMIT, DEFAULT_MIN_COUNT, Format, MAX_GAUSSIANS, MAX_NEGATIVES, MAX_TEXTS,
    RequestError, Words,
};
use crate::score::{MAX_COORDINATE, Precision};

/// Questions and what they share.
#[derive(Deserialize, JsonSchema)]
#[schemars(inline)]
pub struct AskParams {
    /// What to look for; may be repeated. A text that names a relation (mug on the table) is understood as a phrase.
    #[schemars(with = "Vec<Words>", length(min = 1, max = MAX_TEXTS), example = ["mug on the table"])]
    text: Vec<String>,
    /// off: take texts as they are, even if they name a relation.
    #[schemars(example = &"off")]
    #[serde(default)]
    relations: Switch,
    /// A negative prompt, commas included; may be repeated; or canonical alone: object, things, stuff, texture.
    #[serde(default)]
    #[schemars(with = "Vec<Words>", length(max = MAX_NEGATIVES), example = ["wall, floor"])]
    negative: Vec<String>,
    /// Kind of answers; by default objects, and clusters for what no object answers.
    #[schemars(example = &"objects")]
    kind: Option<AnswerKind>,
    /// Most answers to a text. Over all texts at most 10,000, or 1,000,000 Gaussians that come at once.
    #[schemars(range(min = 1, max = MAX_GAUSSIANS), extend("default" = DEFAULT_LIMIT), example = 10)]
    limit: Option<usize>,
    /// Answers to a text before the page; `/query` has one page.
    #[serde(default)]
    #[schemars(example = 0)]
    offset: usize,
    /// Least cosine, or with negatives least relevancy, of a match; by default the scene's, or 0.5.
    #[schemars(range(min = -1, max = 1), example = 0.1)]
    min_score: Option<f32>,
    /// Where the asker is: answers have distances, nearer ones rank higher, and relations are seen from there.
    #[schemars(example = &"2,1.5,0")]
    near: Option<XyzText>,
    /// The same on the earth, WGS 84: lat,lon or lat,lon,height; for scenes with a place on the earth.
    #[schemars(example = &"46.8,-92.1")]
    near_lat_lon: Option<LatLonText>,
    /// Where the asker looks, from the world's x towards y.
    #[schemars(example = 1.57)]
    heading_rad: Option<f64>,
    /// Only within this distance of the asker, world units.
    #[schemars(extend("exclusiveMinimum" = 0, "maximum" = MAX_COORDINATE), example = 5)]
    radius: Option<f64>,
    /// Least Gaussians of an answer; smaller clusters are counted.
    #[schemars(range(min = 1), extend("default" = DEFAULT_MIN_COUNT), example = 10)]
    min_count: Option<u64>,
    /// Edge of the voxels that join Gaussians to clusters, world units.
    #[schemars(extend("exclusiveMinimum" = 0, "maximum" = MAX_COORDINATE), example = 0.25)]
    voxel: Option<f64>,
    /// Data that scores come from.
    #[serde(default)]
    #[schemars(example = &"measured")]
    precision: Precision,
    /// Give up after this time.
    #[schemars(range(min = 1), example = 500)]
    time_budget_ms: Option<u64>,
}

#[derive(Default, PartialEq, Deserialize, serde::Serialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
#[schemars(inline)]
enum Switch {
    #[default]
    On,
    Off,
}

/// What `/query` takes besides.
#[derive(Deserialize, JsonSchema)]
#[schemars(inline)]
pub struct ShortParams {
    /// Format of the answers. arrow: Gaussians as columns, only with kind=gaussians; Accept:
    /// application/vnd.apache.arrow.stream has the same effect. ply: the answers' Gaussians as points.
    #[schemars(extend("default" = Format::default()), example = &"json")]
    format: Option<Format>,
    /// Another name of min_score.
    #[schemars(range(min = -1, max = 1), example = 0.1)]
    threshold: Option<f32>,
    /// none, canonical (object, things, stuff, texture) or a,b,c: all negative prompts in one text. Scores are then
    /// LERF's relevancy, 1 / (1 + exp(-10 (q.E - max n.E))).
    #[schemars(example = &"canonical")]
    negatives: Option<NegativesText>,
}

impl AskParams {
    pub fn ask(self, area: AreaParams) -> Result<Ask, RequestError> {
        let near = forms::point(self.near, self.near_lat_lon)?;
        let ball = match (self.radius, near) {
            (None, _) => None,
            (Some(radius), Some(centre)) => Some((centre, radius)),
            (Some(radius), None) => {
                let expected = format!("where the asker is, because radius is {radius}");
                return Err(RequestError::new("near", "nothing", expected));
            }
        };
        let region = area.area(ball)?;
        Ok(Ask {
            texts: self.text,
            relations: Some(self.relations == Switch::On),
            negatives: self.negative.into(),
            kind: self.kind,
            region,
            near,
            heading_rad: self.heading_rad,
            min_score: self.min_score,
            limit: self.limit,
            offset: self.offset,
            min_count: self.min_count,
            voxel: self.voxel,
            precision: self.precision,
            time_budget_ms: self.time_budget_ms,
            ..Ask::default()
        })
    }
}

impl ShortParams {
    pub fn ask(self, params: AskParams, area: AreaParams, headers: &HeaderMap) -> Result<Ask, RequestError> {
        let mut ask = params.ask(area)?;
        let twice = |parameter: &str, other: &str| {
            Err(RequestError::new(parameter, &format!("{other} as well"), "one of the two"))
        };
        if let Some(threshold) = self.threshold
            && ask.min_score.replace(threshold).is_some()
        {
            return twice("threshold", "min_score");
        }
        if let Some(NegativesText(negatives)) = self.negatives
            && !std::mem::replace(&mut ask.negatives, negatives).0.is_empty()
        {
            return twice("negatives", "negative");
        }
        let format = self.format.unwrap_or_else(|| accepted(headers));
        #[cfg(feature = "arrow")]
        if let (Format::Arrow, kind) = (format, ask.kind)
            && kind != Some(AnswerKind::Gaussians)
        {
            let found = kind.unwrap_or_default().to_string();
            return Err(RequestError::new("kind", &found, "gaussians, since format is arrow"));
        }
        ask.format = Some(format);
        Ok(ask)
    }
}

#[cfg_attr(
    not(feature = "arrow"),
    expect(unused_variables, reason = "JSON is the only format that it names")
)]
fn accepted(headers: &HeaderMap) -> Format {
    #[cfg(feature = "arrow")]
    {
        let arrow = Format::Arrow.media_type();
        let values =
            headers.get_all(axum::http::header::ACCEPT).iter().filter_map(|value| value.to_str().ok());
        let mut ranges = values.flat_map(|value| value.split(','));
        if ranges.any(|range| range.split(';').next().is_some_and(|r| r.trim().eq_ignore_ascii_case(arrow))) {
            return Format::Arrow;
        }
    }
    Format::Json
}

/// Names refused parameters as the query string does.
pub async fn as_in_query(request: Request, next: Next) -> Response {
    let query = request.uri().query().map(str::to_owned);
    let mut response = next.run(request).await;
    if let Some(query) = query
        && let Some(problem) = response.extensions_mut().get_mut::<Problem>()
        && let Some(name) = problem.parameter().and_then(|parameter| in_query(parameter, &query))
    {
        problem.rename_parameter(name);
    }
    response
}

/// Returns another name of a parameter if the query string does not contain it.
fn in_query(parameter: &str, query: &str) -> Option<&'static str> {
    let has = |wanted: &str| query.split('&').any(|pair| pair.split('=').next() == Some(wanted));
    match parameter {
        given if has(given) => None,
        "texts" | "phrases" => Some("text"),
        "threshold" => Some("min_score"),
        "negatives" => Some("negative"),
        "near" | "centre" if has("near_lat_lon") => Some("near_lat_lon"),
        "centre" => Some("near"),
        "polygon" if has("polygon_lat_lon") => Some("polygon_lat_lon"),
        _ => None,
    }
}

/// Returns a function that names refused members as the JSON does.
pub fn as_in_json(ask: Option<&Ask>) -> impl Fn(Problem) -> Problem + use<> {
    let has_phrases_alone = ask.is_some_and(|ask| ask.texts.is_empty() && !ask.phrases.is_empty());
    let of_words = if has_phrases_alone { "phrases" } else { "texts" };
    move |mut problem| {
        let name = match problem.parameter() {
            Some("text") => of_words,
            Some("threshold") => "min_score",
            _ => return problem,
        };
        problem.rename_parameter(name);
        problem
    }
}
