//! Rows of an element: of one size or with lists, in binary or ascii, one block or line at a time.

use super::{Field, Vertex};
use crate::ingest::bounded::read_line;
use crate::ingest::clouds::Gathered;
use ply_rs_bw::ply::{ElementDef, Encoding, PropertyType, ScalarType};
use std::io::{self, BufRead, Read};

/// A line of an ascii file: one row.
const MAX_LINE_BYTES: u64 = 64 << 10;
/// Bytes of rows read at once.
const BLOCK_BYTES: usize = 64 << 10;

/// A property of a row.
enum Column {
    Scalar(ScalarType, Option<Field>),
    /// Type of the count and of what follows; never of interest.
    List(ScalarType, ScalarType),
}

/// How the rows of an element are written.
pub(super) struct Rows {
    columns: Vec<Column>,
    /// Bytes of a row, where all have as many.
    bytes: Option<usize>,
    /// Reads a binary number; `None`: the file is ascii.
    number: Option<fn(&[u8], &ScalarType) -> f64>,
}

impl Rows {
    pub fn of(element: &ElementDef, encoding: &Encoding) -> Self {
        let column = |name: &str, data_type: &PropertyType| match data_type {
            PropertyType::Scalar(scalar) => Column::Scalar(scalar.clone(), Field::of(name)),
            PropertyType::List(count, item) => Column::List(count.clone(), item.clone()),
        };
        let columns: Vec<_> = element.properties.values().map(|p| column(&p.name, &p.data_type)).collect();
        let width = |column: &Column| match column {
            Column::Scalar(scalar, _) => Some(size_of_scalar(scalar)),
            Column::List(..) => None,
        };
        let number: Option<fn(&[u8], &ScalarType) -> f64> = match encoding {
            Encoding::Ascii => None,
            Encoding::BinaryLittleEndian => Some(little_endian),
            Encoding::BinaryBigEndian => Some(big_endian),
        };
        Self { bytes: columns.iter().map(width).sum(), columns, number }
    }

    pub fn skip(&self, source: &mut impl BufRead, count: usize) -> Result<(), String> {
        match (self.number, self.bytes) {
            (Some(_), Some(bytes)) => skip_bytes(source, bytes as u64 * count as u64),
            (Some(number), None) => (0..count).try_for_each(|_| self.read_uneven(source, number, &mut Vertex::new())),
            (None, _) => {
                let mut line = Vec::new();
                (0..count).try_for_each(|row| next_line(source, &mut line, row, count))
            }
        }
    }

    pub fn read(&self, source: &mut impl BufRead, count: usize, gathered: &mut Gathered) -> Result<(), String> {
        match (self.number, self.bytes) {
            (Some(number), Some(bytes)) => self.read_even(source, count, bytes, number, gathered),
            (Some(number), None) => (0..count).try_for_each(|_| {
                let mut vertex = Vertex::new();
                self.read_uneven(source, number, &mut vertex)?;
                vertex.hand_to(gathered);
                Ok(())
            }),
            (None, _) => self.read_ascii(source, count, gathered),
        }
    }

    fn read_ascii(&self, source: &mut impl BufRead, count: usize, gathered: &mut Gathered) -> Result<(), String> {
        let mut line = Vec::new();
        for row in 0..count {
            next_line(source, &mut line, row, count)?;
            let text = std::str::from_utf8(&line).map_err(|e| format!("vertex {row}: {e}"))?;
            let mut words = text.split_ascii_whitespace();
            let too_few = || {
                let (found, announced) = (text.split_ascii_whitespace().count(), self.columns.len());
                format!("vertex {row} has {found} values, its header announces {announced}")
            };
            let mut vertex = Vertex::new();
            for column in &self.columns {
                let word = words.next().ok_or_else(too_few)?;
                let not_a_number = || format!("vertex {row}: {word:?} is not a number");
                match column {
                    Column::Scalar(scalar, Some(field)) => vertex.set(*field, word.parse().map_err(|_| not_a_number())?, scalar),
                    Column::Scalar(_, None) => {}
                    Column::List(..) => {
                        let items: usize = word.parse().map_err(|_| not_a_number())?;
                        if items > 0 {
                            words.nth(items - 1).ok_or_else(too_few)?;
                        }
                    }
                }
            }
            vertex.hand_to(gathered);
        }
        Ok(())
    }

    /// Rows of one size, a block at a time.
    fn read_even(
        &self,
        source: &mut impl BufRead,
        count: usize,
        bytes: usize,
        number: fn(&[u8], &ScalarType) -> f64,
        gathered: &mut Gathered,
    ) -> Result<(), String> {
        let mut fields = Vec::new();
        let mut offset = 0;
        for column in &self.columns {
            if let Column::Scalar(scalar, field) = column {
                fields.extend(field.map(|field| (field, offset, scalar)));
                offset += size_of_scalar(scalar);
            }
        }
        let per_block = (BLOCK_BYTES / bytes).max(1);
        let mut block = vec![0; bytes * per_block];
        let mut left = count;
        while left > 0 {
            let rows = left.min(per_block);
            let block = &mut block[..rows * bytes];
            source.read_exact(block).map_err(|e| format!("truncated: {e}"))?;
            for row in block.chunks_exact(bytes) {
                let mut vertex = Vertex::new();
                for &(field, offset, scalar) in &fields {
                    vertex.set(field, number(&row[offset..], scalar), scalar);
                }
                vertex.hand_to(gathered);
            }
            left -= rows;
        }
        Ok(())
    }

    /// A binary row that holds lists.
    fn read_uneven(&self, source: &mut impl BufRead, number: fn(&[u8], &ScalarType) -> f64, vertex: &mut Vertex) -> Result<(), String> {
        let next = |source: &mut dyn BufRead, scalar: &ScalarType| {
            let mut bytes = [0; 8];
            let read = source.read_exact(&mut bytes[..size_of_scalar(scalar)]);
            read.map(|()| number(&bytes, scalar)).map_err(|e| format!("truncated: {e}"))
        };
        for column in &self.columns {
            match column {
                Column::Scalar(scalar, field) => {
                    let value = next(source, scalar)?;
                    if let Some(field) = field {
                        vertex.set(*field, value, scalar);
                    }
                }
                Column::List(count, item) => {
                    let items = next(source, count)?;
                    if items < 0.0 || items.fract() != 0.0 {
                        return Err(format!("a list of {items} values"));
                    }
                    skip_bytes(source, items as u64 * size_of_scalar(item) as u64)?;
                }
            }
        }
        Ok(())
    }
}

fn next_line(source: &mut impl BufRead, line: &mut Vec<u8>, row: usize, count: usize) -> Result<(), String> {
    match read_line(source, line, MAX_LINE_BYTES) {
        Ok(true) => Ok(()),
        Ok(false) => Err(format!("truncated: {row} of {count} vertices")),
        Err(e) => Err(format!("vertex {row}: {e}")),
    }
}

fn skip_bytes(source: &mut impl BufRead, bytes: u64) -> Result<(), String> {
    match io::copy(&mut source.take(bytes), &mut io::sink()) {
        Ok(skipped) if skipped == bytes => Ok(()),
        Ok(_) => Err("truncated".into()),
        Err(e) => Err(e.to_string()),
    }
}

fn size_of_scalar(scalar: &ScalarType) -> usize {
    match scalar {
        ScalarType::Char | ScalarType::UChar => 1,
        ScalarType::Short | ScalarType::UShort => 2,
        ScalarType::Int | ScalarType::UInt | ScalarType::Float => 4,
        ScalarType::Double => 8,
    }
}

fn first<const N: usize>(bytes: &[u8]) -> [u8; N] {
    std::array::from_fn(|i| bytes[i])
}

fn little_endian(bytes: &[u8], scalar: &ScalarType) -> f64 {
    match scalar {
        ScalarType::Char => f64::from(i8::from_le_bytes(first(bytes))),
        ScalarType::UChar => f64::from(bytes[0]),
        ScalarType::Short => f64::from(i16::from_le_bytes(first(bytes))),
        ScalarType::UShort => f64::from(u16::from_le_bytes(first(bytes))),
        ScalarType::Int => f64::from(i32::from_le_bytes(first(bytes))),
        ScalarType::UInt => f64::from(u32::from_le_bytes(first(bytes))),
        ScalarType::Float => f64::from(f32::from_le_bytes(first(bytes))),
        ScalarType::Double => f64::from_le_bytes(first(bytes)),
    }
}

fn big_endian(bytes: &[u8], scalar: &ScalarType) -> f64 {
    match scalar {
        ScalarType::Char => f64::from(i8::from_be_bytes(first(bytes))),
        ScalarType::UChar => f64::from(bytes[0]),
        ScalarType::Short => f64::from(i16::from_be_bytes(first(bytes))),
        ScalarType::UShort => f64::from(u16::from_be_bytes(first(bytes))),
        ScalarType::Int => f64::from(i32::from_be_bytes(first(bytes))),
        ScalarType::UInt => f64::from(u32::from_be_bytes(first(bytes))),
        ScalarType::Float => f64::from(f32::from_be_bytes(first(bytes))),
        ScalarType::Double => f64::from_be_bytes(first(bytes)),
    }
}
