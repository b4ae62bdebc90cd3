use super::*;
use crate::{Dependencies, Limits, Services};
use bytes::Bytes;
use camino::Utf8Path;
use futures::{SinkExt, Stream, stream};
use proptest::prelude::*;
use sha2::{Digest, Sha256};
use std::convert::Infallible;
use std::fs;
use std::io::Write;
use tempfile::TempDir;
use tokio::runtime::Runtime;
use uniground_ingest::archive::UnpackLimits;
use uniground_storage::{BlobHome, Location, Store};
use uniground_types::stats::Retention;

/// An upload service without workers, over its own folder.
struct UploadFixture {
    data: TempDir,
    store: Store,
    service: std::sync::Arc<UploadService>,
}

impl UploadFixture {
    async fn with_data(data: TempDir) -> Self {
        let store = Store::open(
            Utf8Path::from_path(data.path()).unwrap(),
            &Location::Folder,
            &BlobHome::Folder,
        )
        .await
        .unwrap();
        let limits = Limits {
            max_upload_bytes: 1 << 30,
            max_unfinished_uploads: 10,
            unpack: UnpackLimits::default(),
            keep_free_bytes: 0,
            max_memory_bytes: None,
            max_concurrent_questions: 1,
            retention: Retention::default(),
        };
        let dependencies = Dependencies::offline(store.clone(), limits).await.unwrap();
        let service = Services::new(dependencies).uploads;
        Self { data, store, service }
    }

    async fn new() -> Self {
        Self::with_data(tempfile::tempdir().unwrap()).await
    }

    async fn restart(self) -> Self {
        self.store.close().await;
        let Self { data, store, service } = self;
        drop((store, service));
        Self::with_data(data).await
    }

    async fn start_upload(&self, length: usize) -> String {
        let new = NewUpload { length: length as u64, wanted: SceneRequest::default() };
        self.service.begin_upload(new, &Caller::operator()).await.unwrap().id
    }

    async fn offset(&self, id: &str) -> usize {
        self.service.upload(id, &Caller::operator()).await.unwrap().offset as usize
    }

    async fn append(
        &self,
        id: &str,
        part: UploadPart<impl Stream<Item = Result<Bytes, ()>> + Send + Unpin + 'static>,
    ) -> Result<Upload, Error> {
        self.service.append(id, part, Caller::operator()).await
    }
}

/// Returns a body with these bytes in chunks. The body then ends or breaks off.
fn body(
    bytes: &[u8],
    end: Option<()>,
) -> impl Stream<Item = Result<Bytes, ()>> + Send + Unpin + use<> {
    let chunks: Vec<_> = bytes
        .chunks(7919)
        .map(|chunk| Ok(Bytes::copy_from_slice(chunk)))
        .chain(end.map(Err))
        .collect();
    stream::iter(chunks)
}

fn part<S>(offset: usize, checksum: Option<Checksum>, body: S) -> UploadPart<S> {
    UploadPart { offset: offset as u64, announced_bytes: 0, checksum, body }
}

fn sum_of(bytes: &[u8]) -> Checksum {
    Checksum { algorithm: ChecksumAlgorithm::Sha256, sum: Sha256::digest(bytes).to_vec() }
}

/// Returns bytes that start like an archive, so that they are accepted.
fn archive(length: usize) -> Vec<u8> {
    let mut bytes: Vec<u8> = (0..length).map(|i| (i * i % 251) as u8).collect();
    bytes[..4].copy_from_slice(b"PK\x03\x04");
    bytes
}

/// What happens to a part in transit.
#[derive(Debug, Clone, Copy)]
enum PartDelivery {
    Arrives,
    BreaksOff,
    Checked,
    /// The bytes do not match the checksum.
    Damaged,
    /// Has a checksum and breaks off.
    CheckedAndCut,
    /// Begins at another offset.
    Misplaced,
    /// Is longer than the rest of the upload.
    TooLong,
    /// The server is killed after writing bytes that are not recorded yet.
    Killed,
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// Whatever happens to the parts, the stored bytes equal the sent bytes, and the offset never
    /// exceeds them.
    #[test]
    fn interrupted_parts_reassemble_to_the_same_bytes(
        length in 4usize..60_000,
        parts in prop::collection::vec((0usize..20_000, prop::sample::select(vec![
            PartDelivery::Arrives, PartDelivery::BreaksOff, PartDelivery::Checked, PartDelivery::Damaged, PartDelivery::CheckedAndCut, PartDelivery::Misplaced, PartDelivery::TooLong, PartDelivery::Killed,
        ])), 0..12),
    ) {
        let bytes = archive(length);
        Runtime::new().unwrap().block_on(async {
            let mut fixture = UploadFixture::new().await;
            // One byte more than is sent, so that the upload never completes and no scene is
            // created.
            let id = fixture.start_upload(length + 1).await;
            let mut there = 0;
            for (size, fate) in parts {
                let piece = &bytes[there..(there + size).min(length)];
                let sent = match fate {
                    PartDelivery::Arrives => fixture.append(&id, part(there, None, body(piece, None))).await.map(|_| piece.len()),
                    PartDelivery::Checked => fixture.append(&id, part(there, Some(sum_of(piece)), body(piece, None))).await.map(|_| piece.len()),
                    PartDelivery::BreaksOff => {
                        let broken = fixture.append(&id, part(there, None, body(piece, Some(())))).await;
                        prop_assert!(matches!(broken, Err(Error::UploadInterrupted { .. })), "{broken:?}");
                        Ok(piece.len())
                    }
                    PartDelivery::Damaged => fixture.append(&id, part(there, Some(sum_of(b"others")), body(piece, None))).await.map(|_| 0),
                    PartDelivery::CheckedAndCut => fixture.append(&id, part(there, Some(sum_of(piece)), body(piece, Some(())))).await.map(|_| 0),
                    PartDelivery::Misplaced => fixture.append(&id, part(there + 1, None, body(piece, None))).await.map(|_| 0),
                    PartDelivery::TooLong => {
                        let long = UploadPart { announced_bytes: length as u64 + 2, ..part(there, None, body(piece, None)) };
                        fixture.append(&id, long).await.map(|_| 0)
                    }
                    PartDelivery::Killed => {
                        let path = fixture.store.blobs.upload(&id);
                        fs::OpenOptions::new().create(true).append(true).open(path).unwrap().write_all(b"never noted").unwrap();
                        fixture = fixture.restart().await;
                        Ok(0)
                    }
                };
                let is_refused = matches!(fate, PartDelivery::Damaged | PartDelivery::CheckedAndCut | PartDelivery::Misplaced | PartDelivery::TooLong);
                prop_assert_eq!(sent.is_err(), is_refused, "{:?}: {:?}", fate, sent);
                there += sent.unwrap_or(0);
                prop_assert_eq!(fixture.offset(&id).await, there, "{:?}", fate);
            }
            fixture.append(&id, part(there, None, body(&bytes[there..], None))).await.unwrap();
            prop_assert_eq!(fixture.offset(&id).await, length);
            prop_assert!(fs::read(fixture.store.blobs.upload(&id)).unwrap() == bytes);
            Ok(())
        })?;
    }
}

#[tokio::test]
async fn concurrent_senders_never_mix_bytes() {
    let fixture = UploadFixture::new().await;
    let (bytes, id) = (archive(3000), fixture.start_upload(3001).await);
    let (mut sender, receiver) = futures::channel::mpsc::channel(0);
    let service = fixture.service.clone();
    let first = tokio::spawn({
        let id = id.clone();
        async move { service.append(&id, part(0, None, receiver), Caller::operator()).await }
    });
    // Returns once the service has received the first chunk. From then on the upload is busy.
    sender.send(Ok::<_, Infallible>(Bytes::from(bytes[..1000].to_vec()))).await.unwrap();
    let second = fixture.append(&id, part(0, None, body(&bytes[..0], None))).await;
    assert!(matches!(second, Err(Error::UploadBusy { .. })), "{second:?}");
    assert!(matches!(
        fixture.service.delete_upload(&id, &Caller::operator()).await,
        Err(Error::UploadBusy { .. })
    ));
    sender.send(Ok(Bytes::from(bytes[1000..2000].to_vec()))).await.unwrap();
    drop(sender);
    assert_eq!(first.await.unwrap().unwrap().offset, 2000);
    assert_eq!(
        fixture.append(&id, part(2000, None, body(&bytes[2000..], None))).await.unwrap().offset,
        3000
    );
    assert!(fs::read(fixture.store.blobs.upload(&id)).unwrap() == bytes);
    fixture.service.delete_upload(&id, &Caller::operator()).await.unwrap();
    assert!(matches!(
        fixture.service.upload(&id, &Caller::operator()).await,
        Err(Error::UploadNotFound { .. })
    ));
}

/// The bytes that fit are stored.
#[tokio::test]
async fn bytes_beyond_the_announced_length_are_rejected() {
    let fixture = UploadFixture::new().await;
    let (bytes, id) = (archive(30_000), fixture.start_upload(20_000).await);
    let long = fixture.append(&id, part(0, None, body(&bytes, None))).await;
    assert!(matches!(long, Err(Error::UploadTooLarge { max_bytes: 20_000 })), "{long:?}");
    let there = fixture.offset(&id).await;
    assert!(
        there <= 20_000 && fs::read(fixture.store.blobs.upload(&id)).unwrap() == bytes[..there]
    );
}

/// A backup contains the record but not the file. A file without a record is removed.
#[tokio::test]
async fn an_upload_whose_file_is_missing_restarts_at_zero() {
    let fixture = UploadFixture::new().await;
    let id = fixture.start_upload(9000).await;
    fixture.append(&id, part(0, None, body(&archive(5000), None))).await.unwrap();
    fs::remove_file(fixture.store.blobs.upload(&id)).unwrap();
    fs::write(fixture.store.blobs.upload("stranger"), "x").unwrap();
    let fixture = fixture.restart().await;
    assert_eq!(fixture.offset(&id).await, 0);
    assert!(!fixture.store.blobs.upload("stranger").exists());
    assert_eq!(
        fixture.append(&id, part(0, None, body(&archive(8000), None))).await.unwrap().offset,
        8000
    );
}

#[tokio::test]
async fn invalid_files_are_rejected_by_their_first_bytes() {
    let fixture = UploadFixture::new().await;
    let id = fixture.start_upload(1 << 30).await;
    let upload = fixture.append(&id, part(0, None, body(&[b'x'; 5000], None))).await.unwrap();
    assert_eq!(
        (upload.state, upload.problem.unwrap().code.as_str()),
        (UploadState::Refused, "archive_unreadable")
    );
    assert!(!fixture.store.blobs.upload(&id).exists());
}
