//! Schemas of requests and replies, and the names that refer to them.

use std::collections::{BTreeMap, BTreeSet};

use schemars::generate::{SchemaGenerator, SchemaSettings};
use schemars::transform::{Transform, transform_subschemas};
use schemars::{JsonSchema, Schema};
use serde_json::{Map, Value, json};

use crate::replies::{Reply, SchemaOf};

/// Path of the schemas in a description.
const SCHEMAS: &str = "#/components/schemas/";
/// Path of requests' schemas under construction.
const REQUESTS: &str = "#/requests/";
/// Suffix of a request's schema that differs from the reply's of the same type.
const SUFFIX: &str = "Request";

/// Schemas under construction. A type may have two: members optional in requests are always present in replies.
pub struct Schemas {
    replies: SchemaGenerator,
    requests: SchemaGenerator,
}

impl Default for Schemas {
    fn default() -> Self {
        let at = |path: &'static str| {
            SchemaSettings::draft2020_12().with(|settings| {
                settings.definitions_path = path.trim_end_matches('/').into();
                settings.meta_schema = None;
            })
        };
        let replies = at(SCHEMAS).for_serialize().with_transform(Tidy { is_reply: true });
        let requests = at(REQUESTS).for_deserialize().with_transform(Tidy { is_reply: false });
        Self { replies: replies.into_generator(), requests: requests.into_generator() }
    }
}

impl Schemas {
    pub fn of_reply<T: JsonSchema>(&mut self) -> Value {
        tidied(self.replies.subschema_for::<T>(), true)
    }

    /// Returns a handler's successful replies, with their schemas as references.
    pub fn replies(&mut self, of: fn(&mut SchemaGenerator) -> Vec<Reply>) -> Vec<Reply> {
        of(&mut self.replies)
    }

    pub fn of_request(&mut self, of: SchemaOf) -> Value {
        tidied(of(&mut self.requests), false)
    }

    /// Moves the named schemas into a document, and their final names into its references.
    pub fn finish(mut self, document: &mut Value) {
        let mut named = self.replies.take_definitions(true);
        let requests = self.requests.take_definitions(true);
        let mut names: BTreeMap<String, String> =
            requests.keys().map(|name| (name.clone(), name.clone())).collect();
        // A schema that refers to a renamed one differs as well.
        loop {
            let differs = |name: &str| {
                let mut schema = requests[name].clone();
                refer(&mut schema, &names);
                named.get(name).is_some_and(|of_reply| *of_reply != schema)
            };
            let same = |(name, known): &(&String, &String)| name == known && differs(name);
            let Some((name, _)) = names.iter().find(same) else { break };
            let name = name.clone();
            names.insert(name.clone(), name + SUFFIX);
        }
        for (name, mut schema) in requests {
            refer(&mut schema, &names);
            named.insert(names[&name].clone(), schema);
        }
        refer(document, &names);
        document["components"]["schemas"] = named.into();
    }
}

/// Replaces references to requests' schemas by their final names.
fn refer(value: &mut Value, names: &BTreeMap<String, String>) {
    match value {
        Value::Object(members) => {
            if let Some(Value::String(to)) = members.get_mut("$ref")
                && let Some(name) = to.strip_prefix(REQUESTS)
            {
                *to = format!("{SCHEMAS}{}", names[name]);
            }
            members.values_mut().for_each(|member| refer(member, names));
        }
        Value::Array(items) => items.iter_mut().for_each(|item| refer(item, names)),
        _ => {}
    }
}

/// Finishes an unnamed schema.
pub fn tidied(mut schema: Schema, is_reply: bool) -> Value {
    Tidy { is_reply }.transform(&mut schema);
    schema.to_value()
}

/// Shortens a type's schema and closes it: unlisted members are not allowed.
#[derive(Clone, Copy)]
struct Tidy {
    is_reply: bool,
}

impl Transform for Tidy {
    fn transform(&mut self, schema: &mut Schema) {
        transform_subschemas(self, schema);
        let Some(members) = schema.as_object_mut() else { return };
        join_names(members);
        // Joins the lines of a doc comment.
        if let Some(Value::String(text)) = members.get_mut("description") {
            *text = text.split_whitespace().collect::<Vec<_>>().join(" ");
        }
        let required: BTreeSet<String> = members
            .get("required")
            .and_then(Value::as_array)
            .into_iter()
            .flatten()
            .filter_map(|name| Some(name.as_str()?.to_owned()))
            .collect();
        let Some(Value::Object(properties)) = members.get_mut("properties") else { return };
        // Absent members are omitted instead of null.
        let optional = properties.iter_mut().filter(|(name, _)| !required.contains(*name));
        optional.for_each(|(_, property)| without_null(property));
        if self.is_reply {
            members.entry("additionalProperties").or_insert(json!(false));
        }
    }
}

/// Merges an enum's names into one list, with their meanings in the description.
fn join_names(members: &mut Map<String, Value>) {
    let Some(Value::Array(variants)) = members.get("oneOf") else { return };
    let Some(names) = variants.iter().map(|variant| variant["const"].as_str()).collect::<Option<Vec<_>>>()
    else {
        return;
    };
    let meanings = variants.iter().filter_map(|variant| {
        Some(format!("{}: {}", variant["const"].as_str()?, variant["description"].as_str()?))
    });
    let own = members.get("description").and_then(Value::as_str).map(str::to_owned);
    let description = own.into_iter().chain(meanings).collect::<Vec<_>>().join(" ");
    let names = json!(names);
    members.remove("oneOf");
    members.insert("type".into(), "string".into());
    members.insert("enum".into(), names);
    members.insert("description".into(), description.into());
}

fn without_null(property: &mut Value) {
    let Some(members) = property.as_object_mut() else { return };
    let is_null = |value: &Value| value == "null" || value["type"] == "null";
    for list in ["type", "anyOf"] {
        let Some(Value::Array(kinds)) = members.get_mut(list) else { continue };
        kinds.retain(|kind| !is_null(kind));
        let [only] = kinds.as_mut_slice() else { continue };
        match only.take() {
            // A member's own description wins over that of its type.
            Value::Object(only) => {
                members.remove(list);
                for (key, value) in only {
                    members.entry(key).or_insert(value);
                }
            }
            only => drop(members.insert(list.into(), only)),
        }
    }
    if members.get("default") == Some(&Value::Null) {
        members.remove("default");
    }
}
