use serde::Deserialize;

use super::*;

#[derive(Debug, Default, PartialEq, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Kind {
    #[default]
    Thing,
    Place,
}

#[derive(Debug, PartialEq, Deserialize)]
#[serde(try_from = "String")]
struct Even(u32);

impl TryFrom<String> for Even {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let even = text.parse().ok().filter(|number| number % 2 == 0);
        even.map(Self).ok_or_else(|| "an even number".into())
    }
}

#[derive(Debug, Default, PartialEq, Deserialize)]
#[serde(default)]
struct What {
    text: Vec<String>,
    kind: Kind,
    even: Option<Even>,
}

#[derive(Debug, PartialEq, Deserialize)]
struct Place {
    radius: f64,
    #[serde(rename = "box")]
    bounds: Option<String>,
    limit: Option<usize>,
}

fn read(query: &str) -> Result<(What, Place), RequestError> {
    Params::parse(&format!("/?{query}").parse().expect("a URI"))
}

#[test]
fn structs_share_a_query_string() {
    let (what, place) = read("text=a+b&radius=%2B1.5&even=4&text=c%2Cd&limit=7&box=&kind=place").unwrap();
    assert_eq!(what, What { text: vec!["a b".into(), "c,d".into()], kind: Kind::Place, even: Some(Even(4)) });
    assert_eq!(place, Place { radius: 1.5, bounds: Some(String::new()), limit: Some(7) });
    assert_eq!(read("radius=2").expect("sound").0, What::default());
}

#[test]
fn refusals_name_parameter_value_and_what_was_expected() {
    let known = "one of text, kind, even, radius, box, limit";
    for (query, parameter, found, expected) in [
        ("text=a", "radius", "nothing", "a value"),
        ("radius=x", "radius", "x", "a number"),
        ("radius=", "radius", "", "a number"),
        ("radius=1&limit=-1", "limit", "-1", "a whole number"),
        ("radius=1&limit=99999999999999999999", "limit", "99999999999999999999", "a whole number"),
        ("radius=1&radius=2", "radius", "2", "one value"),
        ("radius=1&box=a&box=b", "box", "b", "one value"),
        ("radius=1&kind=Thing", "kind", "Thing", "one of thing, place"),
        ("radius=1&even=3", "even", "3", "an even number"),
        ("radius=1&even=2&even=4", "even", "4", "one value"),
        ("radius=1&bounds=2", "bounds", "2", known),
        ("radius=1&%1b=2", "\\u{1b}", "2", known),
        ("radius=1&text=r%ffed", "text", "r\u{FFFD}ed", UTF8),
        ("radius=1&%ff=2", "\u{FFFD}", "2", UTF8),
    ] {
        assert_eq!(read(query), Err(RequestError::new(parameter, found, expected)), "{query}");
    }
    let long = format!("radius=1&{}=2", "é".repeat(50));
    assert_eq!(read(&long).expect_err("unknown").parameter.chars().count(), MAX_NAME_CHARS);
}
