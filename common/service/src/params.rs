//! Query strings as structs: a parameter is a member, repeated for lists.

use std::fmt;
use std::str::FromStr;

use axum::extract::path::ErrorKind;
use axum::extract::rejection::PathRejection;
use axum::extract::{FromRequestParts, Path, Query};
use axum::http::StatusCode;
use axum::http::request::Parts;
use schemars::{JsonSchema, SchemaGenerator};
use serde::de::value::SeqDeserializer;
use serde::de::{
    self, DeserializeOwned, DeserializeSeed, Deserializer, IntoDeserializer, MapAccess, SeqAccess, Visitor,
};
use serde::{Serialize, forward_to_deserialize_any};

use crate::problem::Problem;
use crate::replies::{SchemaOf, Taken};

/// Longest part of an unknown parameter's name in errors.
const MAX_NAME_CHARS: usize = 40;

const UTF8: &str = "text in UTF-8 where %XX stand for its bytes";

#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{parameter}: found {found}, expected {expected}")]
pub struct RequestError {
    pub parameter: String,
    pub found: String,
    pub expected: String,
}

/// The members of [`RequestError`] in a problem.
#[derive(Default, Serialize, JsonSchema)]
pub struct ParameterMembers {
    /// The parameter that is refused.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub parameter: Option<String>,
    /// Its value.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub found: Option<String>,
    /// Values that are taken.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub expected: Option<String>,
}

impl RequestError {
    /// Names a parameter, the value found (cut to 80 characters, control characters escaped) and the values expected.
    pub fn new(parameter: &str, found: &str, expected: impl Into<String>) -> Self {
        let cut: String = found.chars().take(80).collect();
        let dots = if cut.len() < found.len() { "…" } else { "" };
        Self { parameter: parameter.to_owned(), found: format!("{cut:?}{dots}"), expected: expected.into() }
    }

    /// Adds the parameter and its value to an error without them.
    fn at(self, parameter: &str, found: &str) -> Self {
        if self.parameter.is_empty() { Self::new(parameter, found, self.expected) } else { self }
    }
}

/// serde's message becomes the expectation.
impl de::Error for RequestError {
    fn custom<T: fmt::Display>(expected: T) -> Self {
        Self { parameter: String::new(), found: String::new(), expected: expected.to_string() }
    }

    fn unknown_variant(_: &str, expected: &'static [&'static str]) -> Self {
        Self::custom(format!("one of {}", expected.join(", ")))
    }

    fn missing_field(field: &'static str) -> Self {
        Self::new(field, "nothing", "a value")
    }
}

impl From<RequestError> for Problem {
    fn from(error: RequestError) -> Self {
        let detail = error.to_string();
        let RequestError { parameter, found, expected } = error;
        Self::new(StatusCode::BAD_REQUEST, "bad-parameter", "Bad parameter", detail).with(&ParameterMembers {
            parameter: Some(parameter),
            found: Some(found),
            expected: Some(expected),
        })
    }
}

pub struct PathText(pub String);

impl<S: Send + Sync> FromRequestParts<S> for PathText {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Problem> {
        let read = Path::<String>::from_request_parts(parts, state).await;
        let refused = |rejection: PathRejection| match &rejection {
            PathRejection::FailedToDeserializePathParams(failed) => match failed.kind() {
                ErrorKind::InvalidUtf8InPathParam { key } => {
                    RequestError::new(key, parts.uri.path(), UTF8).into()
                }
                kind => Problem::internal(kind),
            },
            other => Problem::internal(other),
        };
        read.map(|Path(text)| Self(text)).map_err(refused)
    }
}

impl Taken for PathText {}

/// A query string as a struct, or a tuple of structs that share it, the last with all that is required. Unknown
/// parameters are refused.
pub struct Params<T>(pub T);

impl<T: DeserializeOwned> Params<T> {
    /// Parses decoded `name=value` pairs.
    pub fn read(pairs: &[(String, String)]) -> Result<T, RequestError> {
        let mut reader = Pairs { pairs, known: Vec::new() };
        let read = T::deserialize(&mut reader);
        let has = |name: &str| pairs.iter().any(|(other, _)| other == name);
        match (read, pairs.iter().find(|(name, _)| !reader.known.contains(&name.as_str()))) {
            // What is missing may have been given by another name.
            (read, Some((name, value))) if read.as_ref().err().is_none_or(|error| !has(&error.parameter)) => {
                let expected = format!("one of {}", reader.known.join(", "));
                Err(RequestError::new(&shown(name), value, expected))
            }
            (read, _) => read,
        }
    }

    pub fn parse(uri: &axum::http::Uri) -> Result<T, RequestError> {
        let pairs = Query::<Vec<(String, String)>>::try_from_uri(uri);
        let refused = |text: String| RequestError::new("query string", &text, "name=value pairs");
        let pairs = pairs.map_err(|e| refused(e.body_text()))?.0;
        // U+FFFD replaces bytes that are not UTF-8.
        let is_lost =
            |(name, value): &&(String, String)| name.contains('\u{FFFD}') || value.contains('\u{FFFD}');
        match pairs.iter().find(is_lost) {
            None => Self::read(&pairs),
            Some((name, value)) => Err(RequestError::new(&shown(name), value, UTF8)),
        }
    }
}

/// Returns an unknown name, shortened for an error.
fn shown(name: &str) -> String {
    name.chars().take(MAX_NAME_CHARS).collect::<String>().escape_debug().to_string()
}

impl<S: Sync, T: DeserializeOwned> FromRequestParts<S> for Params<T> {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Problem> {
        Ok(Self(Self::parse(&parts.uri)?))
    }
}

impl<T: JsonSchema> Taken for Params<T> {
    fn query() -> Option<SchemaOf> {
        Some(|schemas: &mut SchemaGenerator| T::json_schema(schemas))
    }
}

/// The pairs, and the member names of the structs read from them.
struct Pairs<'a> {
    pairs: &'a [(String, String)],
    known: Vec<&'static str>,
}

impl<'de> Deserializer<'de> for &mut Pairs<'_> {
    type Error = RequestError;

    fn deserialize_struct<V: Visitor<'de>>(
        self,
        _: &'static str,
        names: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, RequestError> {
        self.known.extend(names);
        visitor.visit_map(Members { pairs: self.pairs, names: names.iter(), next: None })
    }

    fn deserialize_tuple<V: Visitor<'de>>(self, n_left: usize, visitor: V) -> Result<V::Value, RequestError> {
        struct Structs<'a, 'b>(&'a mut Pairs<'b>, usize);
        impl<'de> SeqAccess<'de> for Structs<'_, '_> {
            type Error = RequestError;

            fn next_element_seed<T: DeserializeSeed<'de>>(
                &mut self,
                seed: T,
            ) -> Result<Option<T::Value>, RequestError> {
                let Some(n_left) = self.1.checked_sub(1) else { return Ok(None) };
                self.1 = n_left;
                seed.deserialize(&mut *self.0).map(Some)
            }
        }
        visitor.visit_seq(Structs(self, n_left))
    }

    fn deserialize_any<V: Visitor<'de>>(self, _: V) -> Result<V::Value, RequestError> {
        Err(de::Error::custom("a struct or a tuple of structs"))
    }

    forward_to_deserialize_any! {
        bool i8 i16 i32 i64 i128 u8 u16 u32 u64 u128 f32 f64 char str string bytes byte_buf option unit unit_struct
        newtype_struct seq tuple_struct map enum identifier ignored_any
    }
}

struct Members<'a> {
    pairs: &'a [(String, String)],
    names: std::slice::Iter<'static, &'static str>,
    /// The member to read next.
    next: Option<(&'static str, Vec<&'a str>)>,
}

impl<'de> MapAccess<'de> for Members<'_> {
    type Error = RequestError;

    fn next_key_seed<K: DeserializeSeed<'de>>(&mut self, seed: K) -> Result<Option<K::Value>, RequestError> {
        for name in self.names.by_ref() {
            let values =
                self.pairs.iter().filter(|(other, _)| other == name).map(|(_, value)| value.as_str());
            let values: Vec<&str> = values.collect();
            if !values.is_empty() {
                self.next = Some((*name, values));
                return seed.deserialize((*name).into_deserializer()).map(Some);
            }
        }
        Ok(None)
    }

    fn next_value_seed<V: DeserializeSeed<'de>>(&mut self, seed: V) -> Result<V::Value, RequestError> {
        let (name, values) = self.next.take().unwrap_or_default();
        let last = values.last().copied().unwrap_or_default();
        seed.deserialize(Values(values)).map_err(|error| error.at(name, last))
    }
}

struct Values<'a>(Vec<&'a str>);

impl<'a> Values<'a> {
    fn one(&self) -> Result<&'a str, RequestError> {
        match *self.0.as_slice() {
            [value] => Ok(value),
            _ => Err(de::Error::custom("one value")),
        }
    }

    fn number<N: FromStr>(&self, expected: &str) -> Result<N, RequestError> {
        self.one()?.trim().parse().map_err(|_| de::Error::custom(expected))
    }
}

impl<'de> IntoDeserializer<'de, RequestError> for Values<'_> {
    type Deserializer = Self;

    fn into_deserializer(self) -> Self {
        self
    }
}

impl<'de> Deserializer<'de> for Values<'_> {
    type Error = RequestError;

    fn deserialize_any<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, RequestError> {
        visitor.visit_str(self.one()?)
    }

    fn deserialize_option<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, RequestError> {
        visitor.visit_some(self)
    }

    fn deserialize_seq<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, RequestError> {
        visitor.visit_seq(SeqDeserializer::new(self.0.into_iter().map(|value| Values(vec![value]))))
    }

    fn deserialize_enum<V: Visitor<'de>>(
        self,
        _: &'static str,
        _: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, RequestError> {
        visitor.visit_enum(self.one()?.into_deserializer())
    }

    fn deserialize_u32<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, RequestError> {
        visitor.visit_u32(self.number("a whole number")?)
    }

    fn deserialize_u64<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, RequestError> {
        visitor.visit_u64(self.number("a whole number")?)
    }

    fn deserialize_f32<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, RequestError> {
        visitor.visit_f32(self.number("a number")?)
    }

    fn deserialize_f64<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, RequestError> {
        visitor.visit_f64(self.number("a number")?)
    }

    forward_to_deserialize_any! {
        bool i8 i16 i32 i64 i128 u8 u16 u128 char str string bytes byte_buf unit unit_struct newtype_struct tuple
        tuple_struct map struct identifier ignored_any
    }
}

#[cfg(test)]
mod tests;
