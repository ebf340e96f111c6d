//! Canonical JSON, the signed form of metadata: sorted members, no spaces, two escapes, no fractions.

use serde_json::Value;

pub fn canonical_json(value: &Value) -> Result<Vec<u8>, String> {
    let mut out = Vec::new();
    write(value, &mut out)?;
    Ok(out)
}

fn write(value: &Value, out: &mut Vec<u8>) -> Result<(), String> {
    match value {
        Value::Null => out.extend(b"null"),
        Value::Bool(flag) => out.extend(flag.to_string().bytes()),
        Value::Number(number) if number.is_i64() || number.is_u64() => out.extend(number.to_string().bytes()),
        Value::Number(number) => {
            return Err(format!(
                "the number {number} is not a whole number of 64 bits, the only kind that canonical JSON has"
            ));
        }
        Value::String(text) => write_text(text, out),
        Value::Array(items) => {
            out.push(b'[');
            for (i, item) in items.iter().enumerate() {
                if i > 0 {
                    out.push(b',');
                }
                write(item, out)?;
            }
            out.push(b']');
        }
        Value::Object(members) => {
            // Sorted here, because another crate may enable serde_json's `preserve_order`.
            let mut members: Vec<(&String, &Value)> = members.iter().collect();
            members.sort_by_key(|(name, _)| *name);
            out.push(b'{');
            for (i, (name, member)) in members.into_iter().enumerate() {
                if i > 0 {
                    out.push(b',');
                }
                write_text(name, out);
                out.push(b':');
                write(member, out)?;
            }
            out.push(b'}');
        }
    }
    Ok(())
}

fn write_text(text: &str, out: &mut Vec<u8>) {
    out.push(b'"');
    for byte in text.bytes() {
        if matches!(byte, b'"' | b'\\') {
            out.push(b'\\');
        }
        out.push(byte);
    }
    out.push(b'"');
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn canonical_form_of_all_kinds_of_values() {
        let value: Value = serde_json::from_str(
            r#" {"b": [1, -2, 18446744073709551615, true, null], "a\"\\": "é\n\u0000", "": {}} "#,
        )
        .expect("JSON");
        let expected = "{\"\":{},\"a\\\"\\\\\":\"é\n\0\",\"b\":[1,-2,18446744073709551615,true,null]}";
        assert_eq!(canonical_json(&value).expect("canonical"), expected.as_bytes());
    }

    #[test]
    fn fractions_have_no_canonical_form() {
        for text in ["1.5", "1e3", "18446744073709551616", "[{\"a\":0.0}]"] {
            let value: Value = serde_json::from_str(text).expect("JSON");
            assert!(canonical_json(&value).is_err(), "{text}");
        }
    }
}
