//! A body as it comes in: a megabyte at a time, never too much and never too slowly. A slow disk slows the sender; nothing but the
//! connection waits for a sender that is slow.

use crate::error::Error;
use bytes::Bytes;
use futures::{Stream, StreamExt};
use std::time::{Duration, Instant};
use tokio::time::timeout;

/// Bytes that are written at once.
const PIECE_BYTES: usize = 1 << 20;
/// A sender that says nothing for so long is given up.
const SILENCE: Duration = Duration::from_secs(20);
/// So is one that is slower than this after a while: a scan of a megabyte would take a quarter of an hour.
const LEAST_BYTES_PER_S: u64 = 1 << 10;
const WHILE: Duration = Duration::from_secs(30);

/// A body, piece by piece.
pub struct Pieces<S> {
    body: S,
    most: u64,
    max_bytes: u64,
    begun: Instant,
    received: u64,
    /// What ended it, told after what came before that.
    end: Option<Result<(), Error>>,
}

impl<E, S: Stream<Item = Result<Bytes, E>> + Unpin> Pieces<S> {
    /// Of a body that may have `most` bytes; where it has more, `max_bytes` is what is told.
    pub fn of(body: S, most: u64, max_bytes: u64) -> Self {
        Self { body, most, max_bytes, begun: Instant::now(), received: 0, end: None }
    }

    /// The next piece; `None` at the end.
    ///
    /// # Errors
    /// [`Error::UploadTooSlow`], [`Error::UploadTooLarge`], [`Error::UploadInterrupted`]; what came before that was given out.
    pub async fn next(&mut self) -> Result<Option<Vec<Bytes>>, Error> {
        let (mut piece, mut bytes) = (Vec::new(), 0);
        while bytes < PIECE_BYTES && self.end.is_none() {
            match self.chunk().await {
                Ok(Some(chunk)) => {
                    bytes += chunk.len();
                    piece.push(chunk);
                }
                end => self.end = Some(end.map(|_| ())),
            }
        }
        match piece.is_empty() {
            true => self.end.replace(Ok(())).unwrap_or(Ok(())).map(|()| None),
            false => Ok(Some(piece)),
        }
    }

    async fn chunk(&mut self) -> Result<Option<Bytes>, Error> {
        let too_slow = || Error::UploadTooSlow { bytes_per_s: LEAST_BYTES_PER_S, silence_s: SILENCE.as_secs() };
        let chunk = timeout(SILENCE, self.body.next()).await.map_err(|_| too_slow())?;
        let Some(chunk) = chunk.transpose().map_err(|_| Error::UploadInterrupted { received: self.received })? else { return Ok(None) };
        self.received += chunk.len() as u64;
        if self.received > self.most {
            return Err(Error::UploadTooLarge { max_bytes: self.max_bytes });
        }
        let elapsed = self.begun.elapsed();
        if elapsed > WHILE && self.received < LEAST_BYTES_PER_S * elapsed.as_secs() {
            return Err(too_slow());
        }
        Ok(Some(chunk))
    }
}
