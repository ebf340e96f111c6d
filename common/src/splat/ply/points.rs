//! Writes answers as a PLY of points: positions, scores and indices of Gaussians.
//!
//! | property | type | content |
//! |---|---|---|
//! | `question` | uint | index of the text; only if there are several |
//! | `answer` | uint | rank of the answer it belongs to, from 1 |
//! | `x`, `y`, `z` | double | the mean, world frame |
//! | `score` | float | its score |
//! | `cell`, `index` | uint | the cell, and the index in the cell's shard; only of points from shards |
//! | `input_index` | uint | index in the input splat file; only where all points have one |

use std::fmt::Write;

use glam::DVec3;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PointProperties {
    pub question: bool,
    /// `cell` and `index`.
    pub shard_index: bool,
    pub input_index: bool,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    pub question: u32,
    /// Rank of its answer, from 1.
    pub answer: u32,
    pub position_in_world: DVec3,
    pub score: f32,
    /// Cell, and index in its shard.
    pub shard_index: (u32, u32),
    pub input_index: u32,
}

impl PointProperties {
    /// Returns the header for `n` points. `comments`: one line each; control and non-ASCII characters are escaped.
    pub fn header(self, n: u64, comments: &[String]) -> String {
        let mut header = "ply\nformat binary_little_endian 1.0\n".to_owned();
        for comment in comments {
            let line: String = comment.chars().map(escaped).collect();
            // Writing to a string cannot fail.
            let _ = writeln!(header, "comment {line}");
        }
        let _ = writeln!(header, "element vertex {n}");
        let has = |is_there: bool, names: &'static [&'static str]| if is_there { names } else { &[] };
        let names = (has(self.question, &["uint question"]).iter())
            .chain(&["uint answer", "double x", "double y", "double z", "float score"])
            .chain(has(self.shard_index, &["uint cell", "uint index"]))
            .chain(has(self.input_index, &["uint input_index"]));
        names.for_each(|name| header += &format!("property {name}\n"));
        header + "end_header\n"
    }

    pub fn point_bytes(self) -> usize {
        4 * (usize::from(self.question)
            + 2
            + 2 * usize::from(self.shard_index)
            + usize::from(self.input_index))
            + 24
    }

    pub fn put(self, point: &Point, rows: &mut Vec<u8>) {
        if self.question {
            rows.extend_from_slice(&point.question.to_le_bytes());
        }
        rows.extend_from_slice(&point.answer.to_le_bytes());
        point.position_in_world.to_array().iter().for_each(|x| rows.extend_from_slice(&x.to_le_bytes()));
        rows.extend_from_slice(&point.score.to_le_bytes());
        if self.shard_index {
            let (cell, index) = point.shard_index;
            [cell, index].iter().for_each(|value| rows.extend_from_slice(&value.to_le_bytes()));
        }
        if self.input_index {
            rows.extend_from_slice(&point.input_index.to_le_bytes());
        }
    }
}

/// PLY headers are lines of ASCII.
fn escaped(c: char) -> String {
    match c {
        ' '..='~' => c.to_string(),
        other => other.escape_default().to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By hand, byte by byte.
    #[test]
    fn a_point_has_the_bytes_its_header_announces() {
        let all = PointProperties { question: true, shard_index: true, input_index: true };
        let header = all.header(1, &["text caf\u{e9}\nelement vertex 9".into()]);
        assert_eq!(
            header,
            "ply\nformat binary_little_endian 1.0\ncomment text caf\\u{e9}\\nelement vertex 9\nelement vertex 1\n\
             property uint question\nproperty uint answer\nproperty double x\nproperty double y\nproperty double z\n\
             property float score\nproperty uint cell\nproperty uint index\nproperty uint input_index\nend_header\n"
        );
        let point = Point {
            question: 1,
            answer: 2,
            position_in_world: DVec3::new(1.0, -2.0, 0.5),
            score: 0.25,
            shard_index: (3, 4),
            input_index: 5,
        };
        let mut rows = Vec::new();
        all.put(&point, &mut rows);
        let mut expected = vec![1, 0, 0, 0, 2, 0, 0, 0];
        for x in [0x3ff0_0000_0000_0000u64, 0xc000_0000_0000_0000, 0x3fe0_0000_0000_0000] {
            expected.extend(x.to_le_bytes());
        }
        expected.extend([0, 0, 0x80, 0x3e, 3, 0, 0, 0, 4, 0, 0, 0, 5, 0, 0, 0]);
        assert_eq!((&rows, rows.len()), (&expected, all.point_bytes()));
        let few = PointProperties { question: false, shard_index: false, input_index: false };
        rows.clear();
        few.put(&point, &mut rows);
        assert_eq!((&rows[..], rows.len()), (&expected[4..36], few.point_bytes()));
    }
}
