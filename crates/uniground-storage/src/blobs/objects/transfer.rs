//! Transfers files to objects and back in pieces: memory use is independent of file size.

use super::{Objects, to_io_error};
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
const MAX_CONCURRENT_PIECES: usize = 4;

impl Objects {
    /// Uploads a file.
    pub(super) async fn put_file(&self, file: &Utf8Path, place: &Path) -> io::Result<()> {
        let mut file = File::open(file).await?;
        let room = self.acquire_piece_permit().await?;
        let first = read_piece(&mut file).await?;
        if first.len() < PIECE {
            let put = self.store.put(place, first.freeze().into()).await;
            drop(room);
            return put.map(drop).map_err(to_io_error);
        }
        let mut upload = self.store.put_multipart(place).await.map_err(to_io_error)?;
        match self.upload_pieces(&mut *upload, file, (first, room)).await {
            Ok(()) => upload.complete().await.map(drop).map_err(to_io_error),
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

    async fn upload_pieces(
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
            if on_their_way.len() >= MAX_CONCURRENT_PIECES
                && let Some(put) = on_their_way.join_next().await
            {
                put?.map_err(to_io_error)?;
            }
            if !is_last {
                let room = self.acquire_piece_permit().await?;
                let piece = read_piece(&mut file).await?;
                next = (!piece.is_empty()).then_some((piece, room));
            }
        }
        while let Some(put) = on_their_way.join_next().await {
            put?.map_err(to_io_error)?;
        }
        Ok(())
    }

    /// Waits for a permit to hold one piece in memory.
    async fn acquire_piece_permit(&self) -> io::Result<OwnedSemaphorePermit> {
        self.pieces.clone().acquire_owned().await.map_err(io::Error::other)
    }

    /// Downloads an object to a new file. Returns the number of bytes.
    pub(super) async fn get_file(&self, place: &Path, file: &Utf8Path) -> io::Result<u64> {
        let mut chunks = self.store.get(place).await.map_err(to_io_error)?.into_stream();
        let (mut file, mut bytes) = (File::create(file).await?, 0);
        while let Some(chunk) = chunks.next().await {
            let chunk = chunk.map_err(to_io_error)?;
            file.write_all(&chunk).await?;
            bytes += chunk.len() as u64;
        }
        file.flush().await?;
        Ok(bytes)
    }
}

/// Reads the next piece of a file; it is shorter at the end of the file.
async fn read_piece(file: &mut File) -> io::Result<BytesMut> {
    let left = file.metadata().await?.len();
    let mut piece = BytesMut::with_capacity(PIECE.min(usize::try_from(left).unwrap_or(PIECE)));
    loop {
        let missing = PIECE - piece.len();
        if missing == 0 || file.read_buf(&mut (&mut piece).limit(missing)).await? == 0 {
            return Ok(piece);
        }
    }
}
