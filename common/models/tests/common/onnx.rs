//! Writes small ONNX files, so that tests can use a model of any kind with known results.

/// An element type, by its number in `TensorProto.DataType` of onnx.proto.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Element(i64);

impl Element {
    pub const F32: Self = Self(1);
    pub const I32: Self = Self(6);
    pub const I64: Self = Self(7);
    pub const F16: Self = Self(10);

    pub fn code(self) -> i64 {
        self.0
    }
}

#[derive(Default)]
struct Message(Vec<u8>);

impl Message {
    fn varint(mut self, mut value: u64) -> Self {
        while value >= 0x80 {
            self.0.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.0.push(value as u8);
        self
    }

    fn number(self, field: u64, value: i64) -> Self {
        self.varint(field << 3).varint(value as u64)
    }

    fn bytes(self, field: u64, bytes: impl AsRef<[u8]>) -> Self {
        let mut message = self.varint(field << 3 | 2).varint(bytes.as_ref().len() as u64);
        message.0.extend_from_slice(bytes.as_ref());
        message
    }

    fn each(self, field: u64, parts: impl IntoIterator<Item = Vec<u8>>) -> Self {
        parts.into_iter().fold(self, |message, part| message.bytes(field, part))
    }
}

/// An input or output: name, element type, dimensions (-1: any).
pub fn value(name: &str, element: Element, shape: &[i64]) -> Vec<u8> {
    let dims = shape.iter().map(|&n| match n {
        -1 => Message::default().bytes(2, "n").0,
        n => Message::default().number(1, n).0,
    });
    let tensor = Message::default().number(1, element.code()).bytes(2, Message::default().each(1, dims).0);
    Message::default().bytes(1, name).bytes(2, Message::default().bytes(1, tensor.0).0).0
}

pub fn constant(name: &str, element: Element, shape: &[i64], values: &[f32]) -> Vec<u8> {
    let raw: Vec<u8> = match element {
        Element::F16 => values.iter().flat_map(|&x| half::f16::from_f32(x).to_le_bytes()).collect(),
        _ => values.iter().flat_map(|x| x.to_le_bytes()).collect(),
    };
    let message = shape.iter().fold(Message::default(), |message, &n| message.number(1, n));
    message.number(2, element.code()).bytes(8, name).bytes(9, raw).0
}

/// A node; attributes are integers, or lists of them.
pub fn node(op: &str, inputs: &[&str], output: &str, attributes: &[(&str, &[i64])]) -> Vec<u8> {
    let message = inputs.iter().fold(Message::default(), |message, input| message.bytes(1, input));
    let attributes = attributes.iter().map(|(name, values)| {
        let attribute = Message::default().bytes(1, name);
        match (*name, *values) {
            ("axes", values) => values.iter().fold(attribute, |a, &v| a.number(8, v)).number(20, 7).0,
            (_, values) => attribute.number(3, values[0]).number(20, 2).0,
        }
    });
    message.bytes(2, output).bytes(4, op).each(5, attributes).0
}

#[derive(Clone, Default)]
pub struct Graph {
    pub nodes: Vec<Vec<u8>>,
    pub constants: Vec<Vec<u8>>,
    pub inputs: Vec<Vec<u8>>,
    pub outputs: Vec<Vec<u8>>,
}

/// A model of operator set 12, whose operators take their axes as attributes.
pub fn model(graph: &Graph) -> Vec<u8> {
    versioned(graph, 7, 12)
}

pub fn versioned(graph: &Graph, ir_version: i64, opset: i64) -> Vec<u8> {
    let Graph { nodes, constants, inputs, outputs } = graph.clone();
    let graph = Message::default().each(1, nodes).bytes(2, "g").each(5, constants).each(11, inputs);
    let opset = Message::default().bytes(1, "").number(2, opset);
    let model = Message::default().number(1, ir_version).bytes(7, graph.each(12, outputs).0);
    model.bytes(8, opset.0).0
}
