//! Reads rows of an element: of fixed size or with lists, in binary or ascii, one block or line at
//! a time.

use super::{Field, Vertex};
use crate::clouds::CloudBuilder;
use crate::limited_reader::read_line;
use ply_rs_bw::ply::{ElementDef, Encoding, PropertyType, ScalarType};
use std::io::{self, BufRead, Read};

/// Maximum length of a line of an ascii file, which is one row.
const MAX_LINE_BYTES: u64 = 64 << 10;
/// Number of bytes of rows that are read at once.
const BLOCK_BYTES: usize = 64 << 10;

/// A property of a row.
enum PlyColumn {
    Scalar(ScalarType, Option<Field>),
    /// A list: the type of its count, the type of its items, and whether it contains a face's
    /// vertices.
    List(ScalarType, ScalarType, ListOf),
}

#[derive(Clone, Copy, PartialEq)]
enum ListOf {
    /// Indices of vertices, from 0.
    Corners,
    Other,
}

/// Maximum number of corners of a face. Larger polygons do not occur in scans.
const MAX_CORNERS: usize = 256;

#[derive(Clone, Copy, PartialEq)]
enum ByteOrder {
    Little,
    Big,
}

/// How the rows of an element are encoded.
pub(super) struct PlyRows {
    columns: Vec<PlyColumn>,
    /// Bytes per row, if all rows have the same size.
    bytes: Option<usize>,
    /// Byte order of numbers. `None`: the file is ascii.
    order: Option<ByteOrder>,
}

impl PlyRows {
    pub fn new(element: &ElementDef, encoding: &Encoding) -> Self {
        let column = |name: &str, data_type: &PropertyType| match data_type {
            PropertyType::Scalar(scalar) => {
                PlyColumn::Scalar(scalar.clone(), Field::from_name(name))
            }
            PropertyType::List(count, item)
                if ["vertex_indices", "vertex_index"].contains(&name) =>
            {
                PlyColumn::List(count.clone(), item.clone(), ListOf::Corners)
            }
            PropertyType::List(count, item) => {
                PlyColumn::List(count.clone(), item.clone(), ListOf::Other)
            }
        };
        let columns: Vec<_> =
            element.properties.values().map(|p| column(&p.name, &p.data_type)).collect();
        let width = |column: &PlyColumn| match column {
            PlyColumn::Scalar(scalar, _) => Some(size_of_scalar(scalar)),
            PlyColumn::List(..) => None,
        };
        let order = match encoding {
            Encoding::Ascii => None,
            Encoding::BinaryLittleEndian => Some(ByteOrder::Little),
            Encoding::BinaryBigEndian => Some(ByteOrder::Big),
        };
        Self { bytes: columns.iter().map(width).sum(), columns, order }
    }

    /// Returns whether the rows are faces.
    pub fn has_corners(&self) -> bool {
        self.columns.iter().any(|column| matches!(column, PlyColumn::List(_, _, ListOf::Corners)))
    }

    pub fn skip(&self, source: &mut impl BufRead, count: usize) -> Result<(), String> {
        match (self.order, self.bytes) {
            (Some(_), Some(bytes)) => skip_bytes(source, bytes as u64 * count as u64),
            (Some(_), None) => self.for_each_variable_row(source, count, |_, _| Ok(())),
            (None, _) => {
                let mut line = Vec::new();
                (0..count).try_for_each(|row| next_line(source, &mut line, row, count))
            }
        }
    }

    pub fn read(
        &self,
        source: &mut impl BufRead,
        count: usize,
        gathered: &mut CloudBuilder,
    ) -> Result<(), String> {
        if let (Some(order), Some(bytes)) = (self.order, self.bytes) {
            return self.read_fixed_rows(source, count, bytes, order, gathered);
        }
        self.for_each_variable_row(source, count, |vertex, _| {
            vertex.push_to(gathered);
            Ok(())
        })
    }

    /// Calls a function with the corners of every face.
    pub fn for_each_face(
        &self,
        source: &mut impl BufRead,
        count: usize,
        mut face: impl FnMut(&[f64]) -> Result<(), String>,
    ) -> Result<(), String> {
        self.for_each_variable_row(source, count, |_, corners| face(corners))
    }

    /// Calls a function with the values of every row. Used for ascii rows and rows with lists.
    fn for_each_variable_row(
        &self,
        source: &mut impl BufRead,
        count: usize,
        mut show: impl FnMut(&Vertex, &[f64]) -> Result<(), String>,
    ) -> Result<(), String> {
        let (mut line, mut corners) = (Vec::new(), Vec::new());
        for row in 0..count {
            let mut vertex = Vertex::new();
            corners.clear();
            if let Some(order) = self.order {
                self.read_variable_row(source, order, &mut vertex, &mut corners)?;
            } else {
                next_line(source, &mut line, row, count)?;
                self.read_line(&line, row, &mut vertex, &mut corners)?;
            }
            show(&vertex, &corners)?;
        }
        Ok(())
    }

    fn read_line(
        &self,
        line: &[u8],
        row: usize,
        vertex: &mut Vertex,
        corners: &mut Vec<f64>,
    ) -> Result<(), String> {
        let text = std::str::from_utf8(line).map_err(|e| format!("row {row}: {e}"))?;
        let mut words = text.split_ascii_whitespace();
        let too_few = || {
            let (found, announced) = (text.split_ascii_whitespace().count(), self.columns.len());
            format!("row {row} has {found} values, but the header declares {announced}")
        };
        for column in &self.columns {
            let word = words.next().ok_or_else(too_few)?;
            let not_a_number = |word: &str| format!("row {row}: {word:?} is not a number");
            match column {
                PlyColumn::Scalar(_, Some(field)) => {
                    vertex.set(*field, word.parse().map_err(|_| not_a_number(word))?);
                }
                PlyColumn::Scalar(_, None) => {}
                PlyColumn::List(_, _, of) => {
                    let items: usize = word.parse().map_err(|_| not_a_number(word))?;
                    for i in 0..items {
                        let word = words.next().ok_or_else(too_few)?;
                        if *of == ListOf::Corners && i < MAX_CORNERS {
                            corners.push(word.parse().map_err(|_| not_a_number(word))?);
                        }
                    }
                }
            }
        }
        Ok(())
    }

    /// Reads rows of fixed size: one block at a time, column by column, so that a column's type is
    /// checked once per block.
    fn read_fixed_rows(
        &self,
        source: &mut impl BufRead,
        count: usize,
        bytes: usize,
        order: ByteOrder,
        gathered: &mut CloudBuilder,
    ) -> Result<(), String> {
        let mut fields = Vec::new();
        let mut offset = 0;
        for column in &self.columns {
            if let PlyColumn::Scalar(scalar, field) = column {
                fields.extend(field.map(|field| (field, offset, scalar)));
                offset += size_of_scalar(scalar);
            }
        }
        let per_block = (BLOCK_BYTES / bytes).max(1);
        let (mut block, mut vertices) =
            (vec![0; bytes * per_block], vec![Vertex::new(); per_block]);
        let mut left = count;
        while left > 0 {
            let rows = left.min(per_block);
            let (block, vertices) = (&mut block[..rows * bytes], &mut vertices[..rows]);
            source.read_exact(block).map_err(|e| format!("truncated: {e}"))?;
            vertices.fill(Vertex::new());
            for &(field, offset, scalar) in &fields {
                let column = block.chunks_exact(bytes).map(|row| &row[offset..]);
                decode_column(column, scalar, order, vertices.iter_mut(), |vertex, value| {
                    vertex.set(field, value);
                });
            }
            vertices.iter().for_each(|vertex| vertex.push_to(gathered));
            left -= rows;
        }
        Ok(())
    }

    /// Reads a binary row that contains lists.
    fn read_variable_row(
        &self,
        source: &mut impl BufRead,
        order: ByteOrder,
        vertex: &mut Vertex,
        corners: &mut Vec<f64>,
    ) -> Result<(), String> {
        for column in &self.columns {
            match column {
                PlyColumn::Scalar(scalar, field) => {
                    let value = next_number(source, scalar, order)?;
                    if let Some(field) = field {
                        vertex.set(*field, value);
                    }
                }
                PlyColumn::List(count, item, of) => {
                    let items = next_number(source, count, order)?;
                    if items < 0.0 || items.fract() != 0.0 {
                        return Err(format!("a list has the invalid length {items}"));
                    }
                    let mut left = items as u64;
                    while *of == ListOf::Corners && left > 0 && corners.len() < MAX_CORNERS {
                        corners.push(next_number(source, item, order)?);
                        left -= 1;
                    }
                    if left > 0 {
                        skip_bytes(source, left.saturating_mul(size_of_scalar(item) as u64))?;
                    }
                }
            }
        }
        Ok(())
    }
}

fn next_line(
    source: &mut impl BufRead,
    line: &mut Vec<u8>,
    row: usize,
    count: usize,
) -> Result<(), String> {
    match read_line(source, line, MAX_LINE_BYTES) {
        Ok(true) => Ok(()),
        Ok(false) => Err(format!("truncated: {row} of {count} rows")),
        Err(e) => Err(format!("row {row}: {e}")),
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

fn next_number(
    source: &mut impl BufRead,
    scalar: &ScalarType,
    order: ByteOrder,
) -> Result<f64, String> {
    let mut bytes = [0; 8];
    source
        .read_exact(&mut bytes[..size_of_scalar(scalar)])
        .map_err(|e| format!("truncated: {e}"))?;
    let mut number = 0.0;
    decode_column([&bytes[..]], scalar, order, [&mut number], |number, value| *number = value);
    Ok(number)
}

/// Decodes the number at the start of each chunk and passes it to its destination.
#[inline]
fn decode_column<'a, P>(
    bytes: impl IntoIterator<Item = &'a [u8]>,
    scalar: &ScalarType,
    order: ByteOrder,
    places: impl IntoIterator<Item = P>,
    mut put: impl FnMut(P, f64),
) {
    macro_rules! each {
        ($number:ty) => {
            for (place, bytes) in places.into_iter().zip(bytes) {
                let bytes = bytes.first_chunk().copied().unwrap_or_default();
                let number = if order == ByteOrder::Little {
                    <$number>::from_le_bytes(bytes)
                } else {
                    <$number>::from_be_bytes(bytes)
                };
                put(place, f64::from(number));
            }
        };
    }
    match scalar {
        ScalarType::Char => each!(i8),
        ScalarType::UChar => each!(u8),
        ScalarType::Short => each!(i16),
        ScalarType::UShort => each!(u16),
        ScalarType::Int => each!(i32),
        ScalarType::UInt => each!(u32),
        ScalarType::Float => each!(f32),
        ScalarType::Double => each!(f64),
    }
}
