//! Embeddings of whole frames, comparable with embeddings of words. They find objects that are in
//! no instance.

use super::{Embeddings, FrameIndex, npy};
use std::collections::BTreeMap;
use std::io::{self, Write};

/// Some frames of a scan, each with the vectors of several crops.
#[derive(Debug, Clone, PartialEq)]
pub struct FrameEmbeddings {
    /// The frame of every row.
    of_row: Vec<FrameIndex>,
    rows: Embeddings,
}

impl FrameEmbeddings {
    /// Creates embeddings; `rows` holds one vector of length `dim` for each entry of `of_row`.
    #[must_use]
    pub fn new(dim: usize, of_row: Vec<FrameIndex>, rows: &[f32]) -> Self {
        Self { of_row, rows: Embeddings::new(dim, rows) }
    }

    /// Returns the frames with the crops nearest to a unit vector, at most `most`, nearest first.
    /// Of consecutive frames it returns only the best, because they show the same.
    ///
    /// # Panics
    /// Panics when `query` has another dimension.
    #[must_use]
    pub fn nearest(&self, query: &[f32], most: usize) -> Vec<FrameIndex> {
        let mut of_frame: BTreeMap<FrameIndex, f32> = BTreeMap::new();
        for (frame, cosine) in self.of_row.iter().zip(self.rows.cosines(query)) {
            let best = of_frame.entry(*frame).or_insert(cosine);
            *best = best.max(cosine);
        }
        let mut ranked: Vec<(usize, FrameIndex, f32)> =
            of_frame.into_iter().enumerate().map(|(at, (frame, best))| (at, frame, best)).collect();
        ranked.sort_by(|(a, _, best_a), (b, _, best_b)| best_b.total_cmp(best_a).then(a.cmp(b)));
        let mut chosen: Vec<(usize, FrameIndex)> = Vec::new();
        for (at, frame, _) in ranked {
            if chosen.len() < most && chosen.iter().all(|(other, _)| other.abs_diff(at) > 1) {
                chosen.push((at, frame));
            }
        }
        chosen.into_iter().map(|(_, frame)| frame).collect()
    }

    /// Returns the number of crops.
    #[must_use]
    pub fn len(&self) -> usize {
        self.of_row.len()
    }

    /// Returns whether there are no crops.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.of_row.is_empty()
    }

    /// Writes the vectors as a numpy array of half floats, one row per crop.
    ///
    /// # Errors
    /// Returns I/O errors of `out`.
    pub fn write_rows(&self, out: impl Write) -> io::Result<()> {
        self.rows.write_rows(out)
    }

    /// Writes the frame of every row as a numpy array of one column.
    ///
    /// # Errors
    /// Returns I/O errors of `out`.
    pub fn write_frames(&self, out: impl Write) -> io::Result<()> {
        npy::write(
            out,
            "<u4",
            [self.of_row.len(), 1],
            self.of_row.iter().flat_map(|frame| frame.0.to_le_bytes()),
        )
    }

    /// Reads the arrays that [`write_rows`](Self::write_rows) and
    /// [`write_frames`](Self::write_frames) wrote.
    ///
    /// # Errors
    /// Returns an error for files that are not such arrays, or do not belong together.
    pub fn read(rows: &[u8], frames: &[u8]) -> io::Result<Self> {
        let ([count, dim], rows) = npy::read(rows, "<f2")?;
        let ([of, one], frames) = npy::read(frames, "<u4")?;
        if one != 1 || of != count || dim == 0 {
            return Err(io::Error::new(
                io::ErrorKind::InvalidData,
                "embeddings and their frames do not match",
            ));
        }
        let of_row = frames
            .as_chunks::<4>()
            .0
            .iter()
            .map(|bytes| FrameIndex(u32::from_le_bytes(*bytes)))
            .collect();
        Ok(Self { of_row, rows: Embeddings::from_half_bytes(dim, rows) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Frames 0, 10, 20, 30, each with two crops. The second crop of frame 20 is nearest to x, then
    /// those of 30, 0 and 10.
    fn sample_embeddings() -> FrameEmbeddings {
        let of_row = [0, 0, 10, 10, 20, 20, 30, 30].map(FrameIndex).to_vec();
        let x = [0.5, 0.1, 0.0, 0.2, -1.0, 0.9, 0.8, 0.8];
        let rows: Vec<f32> = x.iter().flat_map(|&x: &f32| [x, (1.0 - x * x).sqrt()]).collect();
        FrameEmbeddings::new(2, of_row, &rows)
    }

    #[test]
    fn nearest_ranks_frames_by_their_best_crop_and_skips_neighbors() {
        let nearest = |most| {
            sample_embeddings()
                .nearest(&[1.0, 0.0], most)
                .into_iter()
                .map(|frame| frame.0)
                .collect::<Vec<_>>()
        };
        assert_eq!((nearest(1), nearest(2), nearest(9)), (vec![20], vec![20, 0], vec![20, 0]));
    }

    #[test]
    fn written_embeddings_are_read_back_unchanged() {
        let (mut rows, mut frames) = (Vec::new(), Vec::new());
        sample_embeddings().write_rows(&mut rows).unwrap();
        sample_embeddings().write_frames(&mut frames).unwrap();
        assert_eq!(FrameEmbeddings::read(&rows, &frames).unwrap(), sample_embeddings());
        assert!(FrameEmbeddings::read(&frames, &rows).is_err());
        assert!(FrameEmbeddings::read(&rows[..rows.len() - 4], &frames).is_err());
    }
}
