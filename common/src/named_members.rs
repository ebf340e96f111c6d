//! JSON objects with named members; arrays in their place are refused.

/// Implements `Deserialize` from named members only, for structs that derive it with `#[serde(remote = "Self")]`.
/// Derived code alone would also accept an array in declaration order, and so `[lon, lat]` for latitude and
/// longitude. With `; Serialize` it also implements that as derived, for structs that derive both.
#[macro_export]
macro_rules! named_members {
    ($($type:ty),+; Serialize) => {
        $crate::named_members!($($type),+);
        $(impl serde::Serialize for $type {
            fn serialize<S: serde::Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
                <$type>::serialize(self, to)
            }
        })+
    };
    ($($type:ty),+) => { $(
        impl<'de> serde::Deserialize<'de> for $type {
            fn deserialize<D: serde::Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
                struct Members;
                impl<'de> serde::de::Visitor<'de> for Members {
                    type Value = $type;

                    fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                        f.write_str("an object whose members have names")
                    }

                    fn visit_map<A: serde::de::MapAccess<'de>>(self, members: A) -> Result<$type, A::Error> {
                        <$type>::deserialize(serde::de::value::MapAccessDeserializer::new(members))
                    }
                }
                from.deserialize_map(Members)
            }
        }
    )+ };
}
