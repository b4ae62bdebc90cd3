//! Reads a request body in pieces of about one megabyte, up to a size limit. The minimum transfer
//! rate is checked by the receiver (`http/body_rate.rs`).

use crate::error::Error;
use bytes::Bytes;
use futures::{Stream, StreamExt};

/// The bytes that are written at once.
const PIECE_BYTES: usize = 1 << 20;

/// A body that is read piece by piece.
pub struct BodyPieces<S> {
    body: S,
    most: u64,
    max_bytes: u64,
    received: u64,
    /// The end of the body or its error. Reported after the bytes that came before it.
    end: Option<Result<(), Error>>,
}

impl<E, S: Stream<Item = Result<Bytes, E>> + Unpin> BodyPieces<S> {
    /// Wraps a body of at most `most` bytes. The error for a larger body reports `max_bytes`.
    pub fn new(body: S, most: u64, max_bytes: u64) -> Self {
        Self { body, most, max_bytes, received: 0, end: None }
    }

    /// Returns the next piece, or `None` at the end.
    ///
    /// # Errors
    /// [`Error::UploadTooLarge`], [`Error::UploadInterrupted`]. The bytes received before the error
    /// have already been returned.
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
