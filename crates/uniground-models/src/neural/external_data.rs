//! External weights of a network. ONNX files hold at most 2 GB; larger networks name the files that
//! hold their tensors.
//!
//! The protobuf of an ONNX file is scanned, not loaded: tensor data is skipped. Field numbers are
//! those of `onnx.proto`.

use camino::Utf8Path;
use std::collections::BTreeSet;
use std::fs::File;
use std::io::{self, BufReader, Read};

/// A kind of message on the path from a model to the locations of its tensors.
#[derive(Clone, Copy)]
enum Message {
    Model,
    Graph,
    Node,
    Attribute,
    Tensor,
    /// A key and a value.
    Entry,
}

impl Message {
    /// Returns the kind of message in a field, if it leads to tensors.
    fn field(self, number: u64) -> Option<Self> {
        match (self, number) {
            (Self::Model, 7) | (Self::Attribute, 6 | 11) => Some(Self::Graph),
            (Self::Graph, 1) => Some(Self::Node),
            (Self::Node, 5) => Some(Self::Attribute),
            (Self::Graph, 5) | (Self::Attribute, 5 | 10) => Some(Self::Tensor),
            (Self::Tensor, 13) => Some(Self::Entry),
            _ => None,
        }
    }
}

/// Maximum depth of nested graphs. No valid network is deeper.
const MAX_DEPTH: u32 = 64;
/// Maximum length of a file name, bytes.
const MAX_NAME: u64 = 4096;

/// Returns the names of the files that hold tensors of a network, as the network states them. Empty
/// for a file that is not an ONNX protobuf (`.ort`).
///
/// # Errors
/// Returns an error if the file cannot be read.
pub(super) fn external_data(network: &Utf8Path) -> io::Result<BTreeSet<String>> {
    let file = File::open(network)?;
    let length = file.metadata()?.len();
    let mut walk = Walk { reader: BufReader::new(file), at: 0, found: BTreeSet::new() };
    match walk.read_message(Message::Model, length, 0) {
        Ok(()) => Ok(walk.found),
        // The runtime reports a file that is not a network.
        Err(error)
            if matches!(
                error.kind(),
                io::ErrorKind::InvalidData | io::ErrorKind::UnexpectedEof
            ) =>
        {
            Ok(BTreeSet::new())
        }
        Err(error) => Err(error),
    }
}

struct Walk {
    reader: BufReader<File>,
    at: u64,
    found: BTreeSet<String>,
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
        while self.at < end {
            let tag = self.read_varint()?;
            let (number, wire) = (tag >> 3, tag & 7);
            match wire {
                0 => drop(self.read_varint()?),
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
                        (_, _, Some(field)) => self.read_message(field, inner, depth + 1)?,
                        _ => self.skip_bytes(length, end)?,
                    }
                }
                _ => return Err(invalid("not a protobuf file")),
            }
        }
        if key == "location" {
            self.found.insert(value);
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
        let found: Vec<String> = external_data(&file).unwrap().into_iter().collect();
        assert_eq!(found, ["constant.data", "inner.data", "weights.data"]);
    }

    proptest! {
        #[test]
        fn arbitrary_bytes_do_not_cause_an_error(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            let (_keep, file) = written(&bytes);
            prop_assert!(external_data(&file).is_ok());
        }
    }
}
