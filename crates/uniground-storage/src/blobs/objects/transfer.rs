//! Transfers files to objects and back in pieces: memory use is independent of file size.

use super::{Objects, told};
use bytes::{BufMut, BytesMut};
use camino::Utf8Path;
use futures::StreamExt;
use object_store::path::Path;
use object_store::{MultipartUpload, ObjectStoreExt};
use std::io;
use tokio::fs::File;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::sync::OwnedSemaphorePermit;
use tokio::task::JoinSet;

/// Larger files are uploaded in pieces of this size.
const PIECE: usize = 8 << 20;
/// Pieces of one file transferred concurrently.
const AT_ONCE: usize = 4;

impl Objects {
    /// Uploads a file.
    pub(super) async fn put_file(&self, file: &Utf8Path, place: &Path) -> io::Result<()> {
        let mut file = File::open(file).await?;
        let room = self.room().await?;
        let first = piece_of(&mut file).await?;
        if first.len() < PIECE {
            let put = self.store.put(place, first.freeze().into()).await;
            drop(room);
            return put.map(drop).map_err(told);
        }
        let mut upload = self.store.put_multipart(place).await.map_err(told)?;
        match self.put_pieces(&mut *upload, file, (first, room)).await {
            Ok(()) => upload.complete().await.map(drop).map_err(told),
            Err(error) => {
                // Its uploaded parts occupy space until the bucket's lifecycle rules remove them.
                if let Err(left) = upload.abort().await {
                    tracing::debug!(
                        error = &left as &dyn std::error::Error,
                        "failed multipart upload could not be aborted in the object store"
                    );
                }
                Err(error)
            }
        }
    }

    async fn put_pieces(
        &self,
        upload: &mut dyn MultipartUpload,
        mut file: File,
        first: (BytesMut, OwnedSemaphorePermit),
    ) -> io::Result<()> {
        let mut on_their_way = JoinSet::new();
        let mut next = Some(first);
        while let Some((piece, room)) = next.take() {
            let is_last = piece.len() < PIECE;
            let put = upload.put_part(piece.freeze().into());
            on_their_way.spawn(async move {
                let put = put.await;
                drop(room);
                put
            });
            if on_their_way.len() >= AT_ONCE
                && let Some(put) = on_their_way.join_next().await
            {
                put?.map_err(told)?;
            }
            if !is_last {
                let room = self.room().await?;
                let piece = piece_of(&mut file).await?;
                next = (!piece.is_empty()).then_some((piece, room));
            }
        }
        while let Some(put) = on_their_way.join_next().await {
            put?.map_err(told)?;
        }
        Ok(())
    }

    /// Waits for a permit to hold one piece in memory.
    async fn room(&self) -> io::Result<OwnedSemaphorePermit> {
        self.pieces.clone().acquire_owned().await.map_err(io::Error::other)
    }

    /// Downloads an object to a new file. Returns the number of bytes.
    pub(super) async fn get_file(&self, place: &Path, file: &Utf8Path) -> io::Result<u64> {
        let mut chunks = self.store.get(place).await.map_err(told)?.into_stream();
        let (mut file, mut bytes) = (File::create(file).await?, 0);
        while let Some(chunk) = chunks.next().await {
            let chunk = chunk.map_err(told)?;
            file.write_all(&chunk).await?;
            bytes += chunk.len() as u64;
        }
        file.flush().await?;
        Ok(bytes)
    }
}

/// Reads the next piece of a file; it is shorter at the end of the file.
async fn piece_of(file: &mut File) -> io::Result<BytesMut> {
    let left = file.metadata().await?.len();
    let mut piece = BytesMut::with_capacity(PIECE.min(usize::try_from(left).unwrap_or(PIECE)));
    loop {
        let missing = PIECE - piece.len();
        if missing == 0 || file.read_buf(&mut (&mut piece).limit(missing)).await? == 0 {
            return Ok(piece);
        }
    }
}
