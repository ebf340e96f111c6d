//! The PLY container: a header, then rows of scalar properties in any encoding, order and type.
//!
//! Grammar after Turk, "The PLY Polygon File Format" (1994): lines of words up to `end_header`,
//! then the rows of each element in the order declared.

use std::fmt::Display;

use crate::splat::error::SplatError;
use crate::splat::input::Input;

/// Headers of splats take 1 to 3 kB plus comments.
const MAX_HEADER_BYTES: u64 = 1 << 20;
/// Binary rows are decoded from a buffer of about this size.
const BUFFER_BYTES: usize = 1 << 16;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Encoding {
    Ascii,
    LittleEndian,
    BigEndian,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn from_name(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// Returns the value at the start of `bytes`, of at least [`Scalar::bytes`]; f64 is exact for every type.
    fn decode(self, bytes: &[u8], encoding: Encoding) -> f64 {
        let mut raw = [0; 8];
        let n = self.bytes();
        raw[..n].copy_from_slice(&bytes[..n]);
        if encoding == Encoding::BigEndian {
            raw[..n].reverse();
        }
        let [a, b, c, d, ..] = raw;
        match self {
            Self::I8 => f64::from(a as i8),
            Self::U8 => f64::from(a),
            Self::I16 => f64::from(i16::from_le_bytes([a, b])),
            Self::U16 => f64::from(u16::from_le_bytes([a, b])),
            Self::I32 => f64::from(i32::from_le_bytes([a, b, c, d])),
            Self::U32 => f64::from(u32::from_le_bytes([a, b, c, d])),
            Self::F32 => f64::from(f32::from_le_bytes([a, b, c, d])),
            Self::F64 => f64::from_le_bytes(raw),
        }
    }
}

#[derive(Clone, Copy, Debug)]
enum Kind {
    Scalar(Scalar),
    List { len: Scalar, item: Scalar },
}

#[derive(Debug)]
struct Property {
    name: String,
    kind: Kind,
}

#[derive(Debug)]
pub(super) struct Element {
    pub name: String,
    /// Number of rows, as declared.
    pub count: u64,
    properties: Vec<Property>,
}

impl Element {
    pub fn property(&self, name: &str) -> Option<usize> {
        self.properties.iter().position(|p| p.name == name)
    }

    /// Returns the largest value of an unsigned integer; `None` of other types.
    pub fn largest(&self, index: usize) -> Option<f64> {
        match self.properties[index].kind {
            Kind::Scalar(Scalar::U8) => Some(f64::from(u8::MAX)),
            Kind::Scalar(Scalar::U16) => Some(f64::from(u16::MAX)),
            _ => None,
        }
    }

    /// Returns the length of a binary row, or `None` if the element has lists.
    fn row_bytes(&self) -> Option<usize> {
        let bytes = |property: &Property| match property.kind {
            Kind::Scalar(scalar) => Some(scalar.bytes()),
            Kind::List { .. } => None,
        };
        self.properties.iter().map(bytes).sum()
    }
}

/// A PLY file, positioned at the rows of the next element.
pub(super) struct Ply {
    pub input: Input,
    encoding: Encoding,
    pub elements: Vec<Element>,
    next: usize,
    line: u64,
}

impl Ply {
    pub fn open(mut input: Input) -> Result<Self, SplatError> {
        let mut header = Header { encoding: None, elements: Vec::new() };
        let mut bytes = Vec::new();
        let mut header_bytes = 0;
        for line in 1.. {
            input.read_line(&mut bytes, MAX_HEADER_BYTES - header_bytes)?;
            header_bytes += bytes.len() as u64;
            let text = String::from_utf8_lossy(&bytes);
            let complete = bytes.ends_with(b"\n");
            let step = if complete { header.line(text.trim()) } else { Err("a line of a PLY header") };
            let expected = match (step, header.encoding) {
                (Ok(false), _) => continue,
                (Ok(true), Some(encoding)) => {
                    return Ok(Self { input, encoding, elements: header.elements, next: 0, line });
                }
                (Ok(true), None) => "a `format` line before `end_header`",
                (Err(expected), _) => expected,
            };
            return Err(at_line(&input, line, expected, excerpt(text.trim())));
        }
        unreachable!("the header's lines are bounded by MAX_HEADER_BYTES")
    }

    pub fn element(&self, name: &str) -> Option<usize> {
        self.elements.iter().position(|e| e.name == name)
    }

    pub fn require_element(&self, name: &str, advice: &str) -> Result<usize, SplatError> {
        let missing = || self.missing(format_args!("an element {name:?}"), advice);
        self.element(name).ok_or_else(missing)
    }

    /// Returns the indices of properties of an element, all of which must exist. `names`: separated by spaces.
    pub fn properties(&self, element: usize, names: &str, advice: &str) -> Result<Vec<usize>, SplatError> {
        let element = &self.elements[element];
        let index = |name: &str| {
            let missing =
                || self.missing(format_args!("property {name:?} of element {:?}", element.name), advice);
            element.property(name).ok_or_else(missing)
        };
        names.split(' ').map(index).collect()
    }

    fn missing(&self, what: impl Display, advice: &str) -> SplatError {
        let fault = format_args!("expected a header with {what}, found none; {advice}");
        SplatError::at(self.input.path(), format_args!("line {}", self.line), fault)
    }

    /// Returns the number of rows of the next element, checked to fit into the rest of the file.
    pub fn checked_count(&self, element: usize) -> Result<usize, SplatError> {
        let element = &self.elements[element];
        let row_bytes = match (self.encoding, element.row_bytes()) {
            // A digit and a separator each; the last line may lack its line feed.
            (Encoding::Ascii, Some(_)) => 2 * element.properties.len(),
            (_, Some(bytes)) => bytes,
            (_, None) => {
                let format = format_args!("a list property in element {:?}", element.name);
                let advice = "export the splat without this property";
                return Err(SplatError::unsupported(self.input.path(), format, advice));
            }
        } as u64;
        let available = self.input.remaining_bytes() + u64::from(self.encoding == Encoding::Ascii);
        match element.count.checked_mul(row_bytes) {
            Some(bytes) if bytes <= available && row_bytes > 0 => Ok(element.count as usize),
            Some(0) => Ok(0),
            _ => {
                let (n, name) = (element.count, &element.name);
                let left = self.input.remaining_bytes();
                let expected = format_args!("{n} rows of {row_bytes} bytes or more ({name:?})");
                Err(self.input.malformed(expected, format_args!("{left} bytes up to the end of the file")))
            }
        }
    }

    /// Positions the file at the rows of `element`, which must not have been passed.
    pub fn seek_element(&mut self, element: usize) -> Result<(), SplatError> {
        if element < self.next {
            let expected = format_args!("element {:?} later in the file", self.elements[element].name);
            let found = "it before an element that it must follow";
            return Err(at_line(&self.input, self.line, expected, found));
        }
        while self.next < element {
            self.skip_element()?;
        }
        Ok(())
    }

    /// Passes the properties `wanted` of each row of the next element, in that order, to `each`. Call
    /// [`Ply::seek_element`] and [`Ply::checked_count`] first.
    pub fn rows(&mut self, wanted: &[usize], mut each: impl FnMut(&[f64])) -> Result<(), SplatError> {
        let element = &self.elements[self.next];
        let mut values = vec![0.0; wanted.len()];
        if self.encoding == Encoding::Ascii {
            let mut line = Vec::new();
            let mut all = Vec::with_capacity(element.properties.len());
            for _ in 0..element.count {
                read_ascii_row(&mut self.input, &mut self.line, &mut line, &mut all)?;
                if all.len() != element.properties.len() {
                    let expected = format_args!("{} numbers", element.properties.len());
                    return Err(at_line(&self.input, self.line, expected, all.len()));
                }
                for (value, &index) in values.iter_mut().zip(wanted) {
                    *value = all[index];
                }
                each(&values);
            }
        } else {
            let mut offset = 0;
            let mut offsets = Vec::with_capacity(element.properties.len());
            for property in &element.properties {
                if let Kind::Scalar(scalar) = property.kind {
                    offsets.push((scalar, offset));
                    offset += scalar.bytes();
                }
            }
            let fields: Vec<_> = wanted.iter().map(|&index| offsets[index]).collect();
            let row_bytes = offset.max(1);
            let rows_at_once = (BUFFER_BYTES / row_bytes).max(1) as u64;
            let mut buffer = vec![0; rows_at_once as usize * row_bytes];
            let mut left = element.count;
            while left > 0 {
                let n = left.min(rows_at_once);
                let part = &mut buffer[..n as usize * row_bytes];
                self.input.fill(part, &element.name)?;
                for row in part.chunks_exact(row_bytes) {
                    for (value, (scalar, offset)) in values.iter_mut().zip(&fields) {
                        *value = scalar.decode(&row[*offset..], self.encoding);
                    }
                    each(&values);
                }
                left -= n;
            }
        }
        self.next += 1;
        Ok(())
    }

    /// Checks that the file ends where its header says: further rows would be omitted silently.
    pub fn finish(mut self) -> Result<(), SplatError> {
        while self.next < self.elements.len() {
            self.skip_element()?;
        }
        self.input.require_end()
    }

    /// Skips all rows of the next element, lists included.
    fn skip_element(&mut self) -> Result<(), SplatError> {
        let element = &self.elements[self.next];
        if self.encoding == Encoding::Ascii {
            let mut line = Vec::new();
            for _ in 0..if element.properties.is_empty() { 0 } else { element.count } {
                read_ascii_row(&mut self.input, &mut self.line, &mut line, &mut Vec::new())?;
            }
        } else if let Some(row_bytes) = element.row_bytes() {
            self.input.skip(element.count.saturating_mul(row_bytes as u64), &element.name)?;
        } else {
            for _ in 0..element.count {
                for property in &element.properties {
                    match property.kind {
                        Kind::Scalar(scalar) => self.input.skip(scalar.bytes() as u64, &element.name)?,
                        Kind::List { len, item } => {
                            let mut raw = [0; 8];
                            self.input.fill(&mut raw[..len.bytes()], &element.name)?;
                            // A negative or huge length saturates; `skip` rejects it.
                            let n = match len.decode(&raw, self.encoding) {
                                n if n >= 0.0 => n as u64,
                                _ => u64::MAX,
                            };
                            self.input.skip(n.saturating_mul(item.bytes() as u64), &element.name)?;
                        }
                    }
                }
            }
        }
        self.next += 1;
        Ok(())
    }
}

/// Reads the numbers of the next line that is not blank.
fn read_ascii_row(
    input: &mut Input,
    line_number: &mut u64,
    line: &mut Vec<u8>,
    values: &mut Vec<f64>,
) -> Result<(), SplatError> {
    values.clear();
    while values.is_empty() {
        input.read_line(line, u64::MAX)?;
        if line.is_empty() {
            return Err(at_line(input, *line_number, "another row after this line", "the end of the file"));
        }
        *line_number += 1;
        for word in line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty()) {
            let found = || excerpt(&String::from_utf8_lossy(word));
            values.push(number(word).ok_or_else(|| at_line(input, *line_number, "a number", found()))?);
        }
    }
    Ok(())
}

fn at_line(input: &Input, line: u64, expected: impl Display, found: impl Display) -> SplatError {
    SplatError::malformed(input.path(), format_args!("line {line}"), expected, found)
}

fn excerpt(text: &str) -> String {
    format!("{:?}", text.chars().take(60).collect::<String>())
}

/// C libraries of Windows write NaN as `-nan(ind)` or `1.#QNAN`.
fn number(word: &[u8]) -> Option<f64> {
    let text = std::str::from_utf8(word).ok()?;
    let bare = text.trim_start_matches('-').to_ascii_lowercase();
    let is_none = bare.starts_with("nan(") || bare.starts_with("1.#");
    if is_none { Some(f64::NAN) } else { text.parse().ok() }
}

struct Header {
    encoding: Option<Encoding>,
    elements: Vec<Element>,
}

impl Header {
    /// Reads a line; returns whether it was the last. The error is the content expected.
    fn line(&mut self, text: &str) -> Result<bool, &'static str> {
        let words: Vec<_> = text.split_ascii_whitespace().collect();
        match words.as_slice() {
            [] | ["ply"] | ["comment" | "obj_info", ..] => {}
            ["format", name, _version] => {
                self.encoding = Some(match *name {
                    "ascii" => Encoding::Ascii,
                    "binary_little_endian" => Encoding::LittleEndian,
                    "binary_big_endian" => Encoding::BigEndian,
                    _ => return Err("format ascii, binary_little_endian or binary_big_endian"),
                });
            }
            ["element", name, count] => {
                let count = count.parse().map_err(|_| "a number of rows")?;
                if self.elements.iter().any(|e| e.name == *name) {
                    return Err("an element that the header does not have yet");
                }
                self.elements.push(Element { name: (*name).into(), count, properties: Vec::new() });
            }
            ["property", rest @ .., name] => {
                let scalar = |name| Scalar::from_name(name).ok_or("a PLY scalar type");
                let kind = match rest {
                    [kind] => Kind::Scalar(scalar(kind)?),
                    ["list", len, item] => Kind::List { len: scalar(len)?, item: scalar(item)? },
                    _ => return Err("`property TYPE NAME` or `property list TYPE TYPE NAME`"),
                };
                let element = self.elements.last_mut().ok_or("an `element` line before any `property`")?;
                if element.property(name).is_some() {
                    return Err("a property that the element does not have yet");
                }
                element.properties.push(Property { name: (*name).into(), kind });
            }
            ["end_header"] => return Ok(true),
            _ => return Err("a line of a PLY header"),
        }
        Ok(false)
    }
}
