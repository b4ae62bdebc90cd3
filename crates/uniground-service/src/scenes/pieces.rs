//! A body as it comes in: a megabyte at a time, and never too much. How slowly it may come is the
//! business of whoever receives it (`http/body_rate.rs`).

use crate::error::Error;
use bytes::Bytes;
use futures::{Stream, StreamExt};

/// Bytes that are written at once.
const PIECE_BYTES: usize = 1 << 20;

/// A body, piece by piece.
pub struct BodyPieces<S> {
    body: S,
    most: u64,
    max_bytes: u64,
    received: u64,
    /// What ended it, told after what came before that.
    end: Option<Result<(), Error>>,
}

impl<E, S: Stream<Item = Result<Bytes, E>> + Unpin> BodyPieces<S> {
    /// Of a body that may have `most` bytes; where it has more, `max_bytes` is what is told.
    pub fn of(body: S, most: u64, max_bytes: u64) -> Self {
        Self { body, most, max_bytes, received: 0, end: None }
    }

    /// The next piece; `None` at the end.
    ///
    /// # Errors
    /// [`Error::UploadTooLarge`], [`Error::UploadInterrupted`]; what came before that was given
    /// out.
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
        let Some(chunk) = self
            .body
            .next()
            .await
            .transpose()
            .map_err(|_| Error::UploadInterrupted { received: self.received })?
        else {
            return Ok(None);
        };
        self.received += chunk.len() as u64;
        if self.received > self.most {
            return Err(Error::UploadTooLarge { max_bytes: self.max_bytes });
        }
        Ok(Some(chunk))
    }
}
