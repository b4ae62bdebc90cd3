//! Measures the time that a parse spends in models. Only for the report: no decision depends on it.

use super::ParseError;
use image::RgbImage;
use std::sync::{Mutex, PoisonError};
use std::time::Instant;
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::{ModelNetwork, ModelTime};
use uniground_models::neural::DualEncoder;

/// Adds up the time that threads spend in models.
#[derive(Debug, Default)]
pub struct ModelClock {
    times: Mutex<Vec<ModelTime>>,
}

impl ModelClock {
    /// Runs a call of a network and records its time, also when it fails.
    pub fn time<T>(&self, network: ModelNetwork, inputs: usize, call: impl FnOnce() -> T) -> T {
        let start = Instant::now();
        let result = call();
        let seconds = start.elapsed().as_secs_f32();
        let mut times = self.times.lock().unwrap_or_else(PoisonError::into_inner);
        match times.iter_mut().find(|time| time.network == network) {
            Some(time) => {
                time.inputs += inputs as u64;
                time.seconds += seconds;
            }
            None => times.push(ModelTime { network, inputs: inputs as u64, seconds }),
        }
        result
    }

    /// Returns the times recorded since the last call, sorted by network.
    pub fn take(&self) -> Vec<ModelTime> {
        let mut times =
            std::mem::take(&mut *self.times.lock().unwrap_or_else(PoisonError::into_inner));
        times.sort_by_key(|time| time.network);
        times
    }
}

/// An encoder of pictures, with the time spent in it.
pub struct PictureEncoder<'a> {
    encoder: &'a DualEncoder,
    /// Time spent in the encoder.
    pub clock: ModelClock,
}

impl<'a> PictureEncoder<'a> {
    /// Starts at no time.
    #[must_use]
    pub fn new(encoder: &'a DualEncoder) -> Self {
        Self { encoder, clock: ModelClock::default() }
    }

    /// Returns the length of an embedding.
    #[must_use]
    pub fn dim(&self) -> usize {
        self.encoder.dim()
    }

    /// Returns one unit vector per picture. Checks for cancellation between calls.
    ///
    /// # Errors
    /// [`ParseError`]: a failed call, or cancellation.
    pub fn embed(
        &self,
        pictures: &[RgbImage],
        progress: &Progress,
    ) -> Result<Vec<Vec<f32>>, ParseError> {
        let mut vectors = Vec::with_capacity(pictures.len());
        for batch in pictures.chunks(self.encoder.batch_size()) {
            progress.check()?;
            let call = || self.encoder.embed_pictures(batch);
            vectors.extend(self.clock.time(ModelNetwork::PictureEncoder, batch.len(), call)?);
        }
        Ok(vectors)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn model_times_are_summed_per_network_until_taken() {
        let clock = ModelClock::default();
        clock.time(ModelNetwork::PictureEncoder, 2, || ());
        clock.time(ModelNetwork::MaskEncoder, 1, || ());
        assert_eq!(clock.time(ModelNetwork::PictureEncoder, 3, || 7), 7);
        let taken: Vec<_> = clock.take().iter().map(|t| (t.network, t.inputs)).collect();
        assert_eq!(taken, [(ModelNetwork::MaskEncoder, 1), (ModelNetwork::PictureEncoder, 5)]);
        assert!(clock.take().is_empty());
    }
}
