//! What an ONNX file says about itself: its inputs and outputs, and the files that hold its weights.
//! ONNX files hold at most 2 GB; larger networks name the files that hold their tensors.
//!
//! The protobuf of an ONNX file is scanned, not loaded: tensor data is skipped. Field numbers are
//! those of `onnx.proto`.

use super::network::{Element, Port, Signature};
use camino::Utf8Path;
use std::collections::BTreeSet;
use std::fs::File;
use std::io::{self, BufReader, Read};

/// The description of a network, read without a runtime.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct OnnxFile {
    /// Inputs and outputs. Weights are not among the inputs.
    pub signature: Signature,
    /// Names of the files that hold tensors of the network, as the network states them.
    pub external_data: BTreeSet<String>,
}

/// A kind of message on the path from a model to its tensors, inputs and outputs.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Message {
    Model,
    Graph,
    Node,
    Attribute,
    Tensor,
    /// A key and a value.
    Entry,
    Input,
    Output,
    Type,
    TensorType,
    Shape,
    Dimension,
}

impl Message {
    /// Returns the kind of message in a field, if it leads to something wanted.
    fn field(self, number: u64) -> Option<Self> {
        match (self, number) {
            (Self::Model, 7) | (Self::Attribute, 6 | 11) => Some(Self::Graph),
            (Self::Graph, 1) => Some(Self::Node),
            (Self::Graph, 11) => Some(Self::Input),
            (Self::Graph, 12) => Some(Self::Output),
            (Self::Node, 5) => Some(Self::Attribute),
            (Self::Graph, 5) | (Self::Attribute, 5 | 10) => Some(Self::Tensor),
            (Self::Tensor, 13) => Some(Self::Entry),
            (Self::Input | Self::Output, 2) => Some(Self::Type),
            (Self::Type, 1) => Some(Self::TensorType),
            (Self::TensorType, 2) => Some(Self::Shape),
            (Self::Shape, 1) => Some(Self::Dimension),
            _ => None,
        }
    }
}

/// Maximum depth of nested messages. No valid network is deeper.
const MAX_DEPTH: u32 = 64;
/// Depth of the messages in the network's own graph. Subgraphs are deeper.
const TOP_LEVEL: u32 = 2;
/// Maximum length of a name, bytes.
const MAX_NAME: u64 = 4096;
/// Maximum number of inputs and outputs, and of dimensions of each.
const MAX_PORTS: usize = 10_000;

/// Reads the description of a network. Empty for a file that is not an ONNX protobuf (`.ort`).
///
/// # Errors
/// Returns an error if the file cannot be read.
pub(super) fn read_onnx(network: &Utf8Path) -> io::Result<OnnxFile> {
    let file = File::open(network)?;
    let length = file.metadata()?.len();
    let mut walk = Walk {
        reader: BufReader::new(file),
        at: 0,
        found: OnnxFile::default(),
        port: no_port(),
        weights: BTreeSet::new(),
    };
    match walk.read_message(Message::Model, length, 0) {
        Ok(()) => {
            let Walk { mut found, weights, .. } = walk;
            // Old files list weights among the inputs.
            found.signature.inputs.retain(|port| !weights.contains(&port.name));
            Ok(found)
        }
        // The runtime reports a file that is not a network.
        Err(error)
            if matches!(
                error.kind(),
                io::ErrorKind::InvalidData | io::ErrorKind::UnexpectedEof
            ) =>
        {
            Ok(OnnxFile::default())
        }
        Err(error) => Err(error),
    }
}

fn no_port() -> Port {
    Port { name: String::new(), element: Element::Other, shape: Vec::new() }
}

struct Walk {
    reader: BufReader<File>,
    at: u64,
    found: OnnxFile,
    /// The input or output that is being read.
    port: Port,
    /// Names of the weights of the network's own graph.
    weights: BTreeSet<String>,
}

fn invalid(why: &'static str) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, why)
}

impl Walk {
    fn read_message(&mut self, message: Message, end: u64, depth: u32) -> io::Result<()> {
        if depth > MAX_DEPTH {
            return Err(invalid("graphs are nested too deeply"));
        }
        let (mut key, mut value) = (String::new(), String::new());
        if matches!(message, Message::Input | Message::Output) {
            self.port = no_port();
        }
        if message == Message::Dimension {
            if self.port.shape.len() >= MAX_PORTS {
                return Err(invalid("too many dimensions"));
            }
            // Without a value: any size.
            self.port.shape.push(-1);
        }
        while self.at < end {
            let tag = self.read_varint()?;
            let (number, wire) = (tag >> 3, tag & 7);
            match wire {
                0 => {
                    let read = self.read_varint()?;
                    match (message, number) {
                        (Message::TensorType, 1) => self.port.element = element(read),
                        (Message::Dimension, 1) => {
                            if let Some(last) = self.port.shape.last_mut() {
                                *last = i64::try_from(read).unwrap_or(-1);
                            }
                        }
                        _ => {}
                    }
                }
                1 => self.skip_bytes(8, end)?,
                5 => self.skip_bytes(4, end)?,
                2 => {
                    let length = self.read_varint()?;
                    let inner = self
                        .at
                        .checked_add(length)
                        .filter(|inner| *inner <= end)
                        .ok_or_else(|| invalid("a field is too long"))?;
                    match (message, number, message.field(number)) {
                        (Message::Entry, 1, _) => key = self.read_text(length)?,
                        (Message::Entry, 2, _) => value = self.read_text(length)?,
                        (Message::Input | Message::Output, 1, _) => {
                            self.port.name = self.read_text(length)?;
                        }
                        (Message::Tensor, 8, _) if depth == TOP_LEVEL => {
                            let name = self.read_text(length)?;
                            self.weights.insert(name);
                        }
                        (_, _, Some(field)) => self.read_message(field, inner, depth + 1)?,
                        _ => self.skip_bytes(length, end)?,
                    }
                }
                _ => return Err(invalid("not a protobuf file")),
            }
        }
        if key == "location" {
            self.found.external_data.insert(value);
        }
        let signature = &mut self.found.signature;
        let ports = match message {
            Message::Input => &mut signature.inputs,
            Message::Output => &mut signature.outputs,
            _ => return Ok(()),
        };
        if depth == TOP_LEVEL {
            if ports.len() >= MAX_PORTS {
                return Err(invalid("too many inputs or outputs"));
            }
            ports.push(std::mem::replace(&mut self.port, no_port()));
        }
        Ok(())
    }

    fn read_varint(&mut self) -> io::Result<u64> {
        let mut value = 0;
        for shift in (0..64).step_by(7) {
            let mut byte = [0];
            self.reader.read_exact(&mut byte)?;
            self.at += 1;
            value |= u64::from(byte[0] & 0x7f) << shift;
            if byte[0] < 0x80 {
                return Ok(value);
            }
        }
        Err(invalid("a number is too long"))
    }

    fn skip_bytes(&mut self, length: u64, end: u64) -> io::Result<()> {
        if length > end - self.at {
            return Err(invalid("a field is too long"));
        }
        self.reader
            .seek_relative(i64::try_from(length).map_err(|_| invalid("a field is too long"))?)?;
        self.at += length;
        Ok(())
    }

    fn read_text(&mut self, length: u64) -> io::Result<String> {
        if length > MAX_NAME {
            return Err(invalid("a name is too long"));
        }
        let mut bytes = vec![0; length as usize];
        self.reader.read_exact(&mut bytes)?;
        self.at += length;
        String::from_utf8(bytes).map_err(|_| invalid("a name is not UTF-8"))
    }
}

/// Returns the type of values with this number in `TensorProto.DataType`.
fn element(number: u64) -> Element {
    match number {
        1 => Element::F32,
        7 => Element::I64,
        _ => Element::Other,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn written(bytes: &[u8]) -> (tempfile::TempDir, camino::Utf8PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let file = Utf8Path::from_path(folder.path()).unwrap().join("network.onnx");
        std::fs::write(&file, bytes).unwrap();
        (folder, file)
    }

    fn field(number: u8, inside: &[u8]) -> Vec<u8> {
        assert!(inside.len() < 128);
        [&[number << 3 | 2, inside.len() as u8], inside].concat()
    }

    #[test]
    fn external_files_are_found_in_initializers_constants_and_subgraphs() {
        let tensor = |name: &str| {
            let entry = [field(1, b"location"), field(2, name.as_bytes())].concat();
            let offset = [field(1, b"offset"), field(2, b"4096")].concat();
            [vec![8, 3, 16, 1], field(13, &entry), field(13, &offset), field(9, b"raw bytes")]
                .concat()
        };
        let branch = field(
            5,
            &[field(1, b"then_branch"), field(6, &field(5, &tensor("inner.data")))].concat(),
        );
        let constant = field(5, &field(5, &tensor("constant.data")));
        let graph =
            [field(1, &constant), field(1, &branch), field(5, &tensor("weights.data"))].concat();
        let model = [
            vec![8, 9],
            vec![7 << 3 | 2, (graph.len() | 128) as u8, (graph.len() >> 7) as u8],
            graph,
        ]
        .concat();
        let (_keep, file) = written(&model);
        let found: Vec<String> = read_onnx(&file).unwrap().external_data.into_iter().collect();
        assert_eq!(found, ["constant.data", "inner.data", "weights.data"]);
    }

    #[test]
    fn inputs_and_outputs_are_read_with_types_and_shapes() {
        let dimensions = [field(1, &[1 << 3, 4]), field(1, &field(2, b"batch"))].concat();
        let port = |name: &str, element: u8| {
            let tensor = [vec![1 << 3, element], field(2, &dimensions)].concat();
            [field(1, name.as_bytes()), field(2, &field(1, &tensor))].concat()
        };
        let weight = field(8, b"weight");
        let graph = [
            field(5, &weight),
            field(11, &port("ids", 7)),
            field(11, &port("weight", 1)),
            field(12, &port("rows", 10)),
        ]
        .concat();
        let (_keep, file) = written(&field(7, &graph));
        let Signature { inputs, outputs } = read_onnx(&file).unwrap().signature;
        let expected =
            |name: &str, element| Port { name: name.into(), element, shape: vec![4, -1] };
        assert_eq!(inputs, [expected("ids", Element::I64)]);
        assert_eq!(outputs, [expected("rows", Element::Other)]);
    }

    proptest! {
        #[test]
        fn arbitrary_bytes_do_not_cause_an_error(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            let (_keep, file) = written(&bytes);
            prop_assert!(read_onnx(&file).is_ok());
        }
    }
}
