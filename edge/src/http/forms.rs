//! Parameters that several routes have, and the forms of their values.

use schemars::JsonSchema;
use slag_service::routes::Parameter;

use crate::query::{DEFAULT_MIN_COUNT, OBJECT_ID, RELEVANCY_THRESHOLD};
use crate::score::{MAX_COORDINATE, MAX_CORNERS, Precision};
use crate::text::MAX_TEXT_BYTES;

/// A number as it stands between commas.
const NUMBER: &str = r"-?[0-9]{1,9}(\.[0-9]{1,9})?";
/// A latitude and a longitude.
const LAT_LON: &str = r"-?[0-8]?[0-9](\.[0-9]{1,9})?,-?(1[0-7][0-9]|[0-9]{1,2})(\.[0-9]{1,9})?";

/// At most 512 bytes of UTF-8, without control characters.
#[derive(JsonSchema)]
#[schemars(rename = "Text")]
#[expect(dead_code, reason = "the schema of texts, which handlers take as strings")]
pub struct Words(
    #[schemars(
        length(min = 1, max = MAX_TEXT_BYTES),
        regex(
            pattern = r"^[^\u0000-\u001f\u007f-\u009f]*[^\s\u0000-\u001f\u007f-\u009f][^\u0000-\u001f\u007f-\u009f]*$"
        )
    )]
    String,
);

/// Returns the form of `n` numbers with commas between them.
fn numbers(n: usize) -> String {
    format!("^{NUMBER}(,{NUMBER}){{{}}}$", n - 1)
}

/// The parameter `text`.
pub fn text(example: &'static str, summary: &str) -> Parameter {
    Parameter::new::<Words>("text", example, summary)
}

/// The parameter `id`: an object's.
pub fn object_id(name: &'static str, summary: &str) -> Parameter {
    Parameter::new::<String>(name, "o0123456789abcdef", summary).of_form(OBJECT_ID)
}

/// The parameter `near`.
pub fn near(summary: &str) -> Parameter {
    Parameter::new::<String>("near", "x,y,z", summary).of_form(numbers(3))
}

/// The parameter `near_lat_lon`.
pub fn near_lat_lon() -> Parameter {
    Parameter::new::<String>("near_lat_lon", "lat,lon", "the same on the earth, or lat,lon,height")
        .details("WGS 84; for scenes with a place on the earth.")
        .of_form(format!("^{LAT_LON}(,{NUMBER})?$"))
}

/// A length, world units.
pub fn length(name: &'static str, example: &'static str, summary: &str) -> Parameter {
    Parameter::new::<f64>(name, example, summary)
        .limit("exclusiveMinimum", 0)
        .limit("maximum", MAX_COORDINATE)
}

/// The parameter `box`.
pub fn bounds() -> Parameter {
    Parameter::new::<String>("box", "x,y,z,x,y,z", "only between two opposite corners").of_form(numbers(6))
}

/// The parameter `polygon`.
pub fn polygon() -> Parameter {
    let corner = format!("{NUMBER},{NUMBER}");
    Parameter::new::<String>("polygon", "x,y,x,y,x,y", "only inside this outline, seen from above")
        .details("3 to 256 corners.")
        .of_form(format!("^{corner}(,{corner}){{2,{}}}$", MAX_CORNERS - 1))
}

/// The parameter `polygon_lat_lon`.
pub fn polygon_lat_lon() -> Parameter {
    Parameter::new::<String>("polygon_lat_lon", "lat,lon,...", "the same on the earth")
        .of_form(format!("^{LAT_LON}(,{LAT_LON}){{2,{}}}$", MAX_CORNERS - 1))
}

/// The parameter for the least score of a match.
pub fn least_score(name: &'static str) -> Parameter {
    let summary = format!(
        "least cosine, or with negatives least relevancy, of a match (default: the scene's, or {RELEVANCY_THRESHOLD})"
    );
    Parameter::new::<f32>(name, "0.1", summary).within(-1, 1)
}

/// The parameter `voxel`.
pub fn voxel() -> Parameter {
    length("voxel", "v", "edge of the voxels that join Gaussians to clusters, world units")
}

/// The parameter `min_count`.
pub fn min_count() -> Parameter {
    Parameter::new::<u64>("min_count", "n", "least Gaussians of an answer; smaller clusters are counted")
        .limit("minimum", 1)
        .or(DEFAULT_MIN_COUNT)
}

/// The parameter `precision`.
pub fn precision() -> Parameter {
    let names = Precision::ALL.map(Precision::name).join(", ");
    Parameter::new::<Precision>("precision", "measured", format!("data that scores come from: {names}"))
        .or(Precision::default().name())
}
