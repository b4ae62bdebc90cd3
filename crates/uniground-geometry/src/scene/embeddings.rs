//! Embeddings of instances: vectors that can be compared with embeddings of words.

use super::npy;
use half::f16;
use half::slice::HalfFloatSliceExt;
use multiversion::multiversion;
use rayon::prelude::*;
use std::io::{self, Write};

/// One row per instance, sorted by id. Stored as half floats, which changes a cosine by less than a
/// thousandth.
#[derive(Debug, Clone, PartialEq)]
pub struct Embeddings {
    dim: usize,
    /// Unit vectors, or zeros for an instance that no frame shows.
    rows: Vec<f16>,
    norms: Vec<Norms>,
    /// What all pictures of the scene share; see [`with_shared_mean`](Self::with_shared_mean).
    shared: Vec<f32>,
}

/// Number of zero rows that are added to the seen ones for the mean. Of a few instances alone, the
/// mean would be what they are, and not what all pictures share.
const ZERO_ROWS: f64 = 20.0;

/// Calibration of the fit of words to an instance: logarithms of sums over a vocabulary.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Norms {
    /// From appearance alone.
    pub appearance: f32,
    /// From appearance and measurements together.
    pub joint: f32,
}

/// Rows searched by one thread at a time.
const ROWS_PER_TASK: usize = 4096;

impl Embeddings {
    /// Creates embeddings; `rows` holds one vector of length `dim` per instance.
    #[must_use]
    pub fn new(dim: usize, rows: &[f32]) -> Self {
        let mut halves = vec![f16::ZERO; rows.len()];
        halves.convert_from_f32_slice(rows);
        Self::from_halves(dim, halves)
    }

    fn from_halves(dim: usize, rows: Vec<f16>) -> Self {
        let norms = vec![Norms::default(); rows.len() / dim];
        Self { dim, rows, norms, shared: vec![0.0; dim] }
    }

    /// Returns the embeddings with the mean of the seen rows as what all pictures share, shrunk
    /// towards zero for a few instances. [`shared_cosine`](Self::shared_cosine) is 0 before.
    #[must_use]
    pub fn with_shared_mean(self) -> Self {
        let (mut sum, mut count) = (vec![0.0_f64; self.dim], ZERO_ROWS);
        for row in self.rows.chunks_exact(self.dim).filter(|row| is_set(row)) {
            sum.iter_mut().zip(row).for_each(|(sum, value)| *sum += value.to_f64());
            count += 1.0;
        }
        Self { shared: sum.into_iter().map(|sum| (sum / count) as f32).collect(), ..self }
    }

    /// Returns the embeddings with calibration norms, one for each instance.
    #[must_use]
    pub fn with_norms(self, norms: Vec<Norms>) -> Self {
        Self { norms, ..self }
    }

    /// Returns at least `count` rows. Added rows are zeros: no frame shows these instances.
    #[must_use]
    pub fn pad_to(mut self, count: usize) -> Self {
        let count = count.max(self.len());
        self.rows.resize(count * self.dim, f16::ZERO);
        self.norms.resize(count, Norms::default());
        self
    }

    /// Returns a row for each of these indices. `None` gives zeros, the row of an instance that no
    /// frame shows.
    #[must_use]
    pub fn select_rows(&self, rows: impl Iterator<Item = Option<usize>>) -> Self {
        let (mut rearranged, unseen) = (
            Self { rows: Vec::new(), norms: Vec::new(), shared: self.shared.clone(), ..*self },
            vec![f16::ZERO; self.dim],
        );
        for row in rows {
            rearranged.rows.extend_from_slice(
                row.map_or(&unseen[..], |at| &self.rows[at * self.dim..(at + 1) * self.dim]),
            );
            rearranged.norms.push(row.map_or_else(Norms::default, |at| self.norms[at]));
        }
        rearranged
    }

    /// Sets the row at `at` to the normalized mean of other rows: the appearance of several
    /// instances that form one.
    #[must_use]
    pub fn with_mean_row(mut self, of: impl IntoIterator<Item = usize>, at: usize) -> Self {
        let (mut sum, mut norms, mut seen) = (vec![0.0; self.dim], Norms::default(), 0.0);
        for index in of.into_iter().filter(|&index| self.is_seen(index)) {
            let row = &self.rows[index * self.dim..(index + 1) * self.dim];
            sum.iter_mut().zip(row).for_each(|(sum, value)| *sum += value.to_f32());
            norms.appearance += self.norms[index].appearance;
            norms.joint += self.norms[index].joint;
            seen += 1.0;
        }
        let length = sum.iter().map(|value| value * value).sum::<f32>().sqrt();
        if length > 0.0 {
            sum.iter_mut().for_each(|value| *value /= length);
            self.rows[at * self.dim..(at + 1) * self.dim].convert_from_f32_slice(&sum);
            self.norms[at] =
                Norms { appearance: norms.appearance / seen, joint: norms.joint / seen };
        }
        self
    }

    /// Returns the length of a row.
    #[must_use]
    pub fn dim(&self) -> usize {
        self.dim
    }

    /// Returns the number of instances, including those that no frame shows.
    #[must_use]
    pub fn len(&self) -> usize {
        self.rows.len() / self.dim
    }

    /// Returns whether there are no instances.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// Returns whether any frame shows the instance at this index.
    #[must_use]
    pub fn is_seen(&self, index: usize) -> bool {
        is_set(&self.rows[index * self.dim..(index + 1) * self.dim])
    }

    /// Returns the vector of the instance at this index; zeros if no frame shows it.
    #[must_use]
    pub fn row(&self, index: usize) -> Vec<f32> {
        self.rows[index * self.dim..(index + 1) * self.dim].iter().map(|v| v.to_f32()).collect()
    }

    /// Returns the cosine of a unit vector with what all pictures of the scene share. Some texts
    /// are close to every picture; without this part, cosines of different texts can be compared.
    ///
    /// # Panics
    /// Panics when `query` has another dimension.
    #[must_use]
    pub fn shared_cosine(&self, query: &[f32]) -> f32 {
        assert_eq!(query.len(), self.dim);
        self.shared.iter().zip(query).map(|(a, b)| a * b).sum()
    }

    /// Returns the calibration norms, sorted by instance id; all 0 until
    /// [`with_norms`](Self::with_norms).
    #[must_use]
    pub fn norms(&self) -> &[Norms] {
        &self.norms
    }

    /// Writes the vectors as a numpy array of half floats, one row per instance.
    ///
    /// # Errors
    /// Returns I/O errors of `out`.
    pub fn write_rows(&self, out: impl Write) -> io::Result<()> {
        let bits: &[u16] = self.rows.reinterpret_cast();
        npy::write(out, "<f2", [self.len(), self.dim], bits.iter().flat_map(|v| v.to_le_bytes()))
    }

    /// Writes the norms as a numpy array of floats with two columns: appearance alone, and with
    /// measurements.
    ///
    /// # Errors
    /// Returns I/O errors of `out`.
    pub fn write_norms(&self, out: impl Write) -> io::Result<()> {
        let values = self.norms.iter().flat_map(|n| [n.appearance, n.joint]);
        npy::write(out, "<f4", [self.len(), 2], values.flat_map(f32::to_le_bytes))
    }

    /// Writes what all pictures share as a numpy array of floats with one row.
    ///
    /// # Errors
    /// Returns I/O errors of `out`.
    pub fn write_shared(&self, out: impl Write) -> io::Result<()> {
        npy::write(out, "<f4", [1, self.dim], self.shared.iter().flat_map(|v| v.to_le_bytes()))
    }

    /// Reads the arrays that [`write_rows`](Self::write_rows), [`write_norms`](Self::write_norms)
    /// and [`write_shared`](Self::write_shared) wrote. Earlier versions did not write the last one;
    /// their norms belong to whole cosines.
    ///
    /// # Errors
    /// Returns an error for files that are not such arrays, or do not belong together.
    pub fn read(rows: &[u8], norms: &[u8], shared: Option<&[u8]>) -> io::Result<Self> {
        let ([count, dim], rows) = npy::read(rows, "<f2")?;
        let ([normed, two], norms) = npy::read(norms, "<f4")?;
        let shared = shared.map(|shared| npy::read(shared, "<f4")).transpose()?;
        let matches = two == 2 && normed == count && dim != 0;
        if !matches || shared.is_some_and(|(shape, _)| shape != [1, dim]) {
            return Err(io::Error::new(
                io::ErrorKind::InvalidData,
                "embeddings and their norms do not match",
            ));
        }
        let floats = |bytes: &[u8]| -> Vec<f32> {
            bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect()
        };
        let shared = shared.map_or_else(|| vec![0.0; dim], |(_, values)| floats(values));
        let norms = floats(norms)
            .as_chunks::<2>()
            .0
            .iter()
            .map(|&[appearance, joint]| Norms { appearance, joint })
            .collect();
        Ok(Self { norms, shared, ..Self::from_half_bytes(dim, rows) })
    }

    /// Creates embeddings from the bytes of half floats, little-endian.
    pub(super) fn from_half_bytes(dim: usize, rows: &[u8]) -> Self {
        let rows: Vec<f16> =
            rows.as_chunks::<2>().0.iter().map(|b| f16::from_le_bytes(*b)).collect();
        Self::from_halves(dim, rows)
    }

    /// Returns the cosine of every instance with a unit vector, by index. The bits are the same on
    /// every machine.
    ///
    /// # Panics
    /// Panics when `query` has another dimension.
    #[must_use]
    pub fn cosines(&self, query: &[f32]) -> Vec<f32> {
        assert_eq!(query.len(), self.dim);
        let rows: &[u16] = self.rows.reinterpret_cast();
        let mut cosines = vec![0.0; self.len()];
        let tasks =
            cosines.par_chunks_mut(ROWS_PER_TASK).zip(rows.par_chunks(ROWS_PER_TASK * self.dim));
        tasks.for_each(|(cosines, rows)| dot_products(rows, query, cosines));
        cosines
    }
}

/// Returns whether a row is not all zeros.
fn is_set(row: &[f16]) -> bool {
    row.iter().any(|v| *v != f16::ZERO)
}

/// Computes the dot products of rows with a query. Lanes are added in one fixed order and no
/// operations are fused, so the bits are the same on every machine.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn dot_products(rows: &[u16], query: &[f32], sums: &mut [f32]) {
    const LANES: usize = 64;
    for (sum, row) in sums.iter_mut().zip(rows.chunks_exact(query.len())) {
        let (row, row_rest) = row.as_chunks::<LANES>();
        let (query, query_rest) = query.as_chunks::<LANES>();
        let mut lanes = [0.0_f32; LANES];
        for (a, b) in row.iter().zip(query) {
            for i in 0..LANES {
                lanes[i] += half_to_float(a[i]) * b[i];
            }
        }
        *sum = lanes.iter().sum::<f32>()
            + row_rest.iter().zip(query_rest).map(|(a, b)| half_to_float(*a) * b).sum::<f32>();
    }
}

/// Converts a finite half float to a float with arithmetic that vectorizes: the exponent is shifted
/// into place and rebased.
#[inline]
fn half_to_float(bits: u16) -> f32 {
    const REBASE: f32 = f32::from_bits(0x7780_0000);
    f32::from_bits((u32::from(bits) & 0x8000) << 16 | (u32::from(bits) & 0x7fff) << 13) * REBASE
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn sample_embeddings(count: usize, dim: usize) -> Embeddings {
        let rows: Vec<f32> = (0..count * dim)
            .map(|i| ((i * 37 % 101) as f32 / 50.0 - 1.0) / (dim as f32).sqrt())
            .collect();
        let norms =
            (0..count).map(|i| Norms { appearance: i as f32, joint: -0.5 * i as f32 }).collect();
        Embeddings::new(dim, &rows).with_norms(norms)
    }

    #[test]
    fn written_embeddings_are_read_back_unchanged() {
        let without_shared = sample_embeddings(7, 70);
        let embeddings = without_shared.clone().with_shared_mean();
        assert_ne!(embeddings, without_shared);
        let (mut rows, mut norms, mut shared) = (Vec::new(), Vec::new(), Vec::new());
        embeddings.write_rows(&mut rows).unwrap();
        embeddings.write_norms(&mut norms).unwrap();
        embeddings.write_shared(&mut shared).unwrap();
        assert_eq!(Embeddings::read(&rows, &norms, Some(&shared)).unwrap(), embeddings);
        assert_eq!(Embeddings::read(&rows, &norms, None).unwrap(), without_shared);
        assert!(Embeddings::read(&norms, &rows, None).is_err());
        assert!(Embeddings::read(&rows[..rows.len() - 1], &norms, None).is_err());
        assert!(Embeddings::read(&rows, &norms[..90], None).is_err());
        assert!(Embeddings::read(&rows, &norms, Some(&norms)).is_err());
    }

    #[test]
    fn shared_cosine_is_that_with_the_mean_of_seen_rows_and_twenty_zeros() {
        let of =
            |rows: &[f32]| Embeddings::new(2, rows).with_shared_mean().shared_cosine(&[0.6, 0.8]);
        // One seen row of 21. Rows that no frame shows do not count.
        assert!((of(&[1.0, 0.0, 0.0, 0.0]) - 0.6 / 21.0).abs() < 1e-6);
        // Ten of 40 along each axis.
        let twenty = [[1.0, 0.0]; 10].into_iter().chain([[0.0, 1.0]; 10]).flatten();
        assert!((of(&twenty.collect::<Vec<f32>>()) - (0.25 * 0.6 + 0.25 * 0.8)).abs() < 1e-6);
        assert_eq!([of(&[]), of(&[0.0; 6])], [0.0; 2]);
        // It stays with the rows where they get other places, and where one is added.
        let embeddings = Embeddings::new(2, &[1.0, 0.0, 0.0, 1.0]).with_shared_mean();
        let turned = embeddings.select_rows([Some(1), None, Some(0)].into_iter()).pad_to(5);
        assert_eq!(turned.shared_cosine(&[0.6, 0.8]), embeddings.shared_cosine(&[0.6, 0.8]));
    }

    #[test]
    fn cosines_match_a_sum_in_double_precision() {
        let embeddings = sample_embeddings(300, 130);
        let query: Vec<f32> = (0..130).map(|i| (i % 13) as f32 / 40.0).collect();
        for (i, cosine) in embeddings.cosines(&query).into_iter().enumerate() {
            let row = &embeddings.rows[i * 130..(i + 1) * 130];
            let expected: f64 =
                row.iter().zip(&query).map(|(a, b)| f64::from(a.to_f32()) * f64::from(*b)).sum();
            assert!((f64::from(cosine) - expected).abs() < 1e-5, "{i}");
        }
        assert!(embeddings.is_seen(0) && !Embeddings::new(3, &[0.0; 6]).is_seen(1));
    }

    proptest! {
        #[test]
        fn half_to_float_is_exact(value in -70000.0_f32..70000.0) {
            let half = f16::from_f32(value);
            prop_assume!(half.is_finite());
            prop_assert_eq!(half_to_float(half.to_bits()), half.to_f32());
        }
    }
}
