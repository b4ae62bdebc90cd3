//! Whether what has come is what was sent.

use bytes::Bytes;
use sha1::Sha1;
use sha2::digest::DynDigest;
use sha2::{Digest, Sha256};

/// How a sum is made.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ChecksumAlgorithm {
    /// For senders that know no better: it tells damage on the way, not intent.
    Sha1,
    Sha256,
}

impl ChecksumAlgorithm {
    pub const ALL: [Self; 2] = [Self::Sha1, Self::Sha256];

    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::Sha1 => "sha1",
            Self::Sha256 => "sha256",
        }
    }

    #[must_use]
    pub fn bytes(self) -> usize {
        self.hasher().output_size()
    }

    fn hasher(self) -> Box<dyn DynDigest + Send> {
        match self {
            Self::Sha1 => Box::new(Sha1::new()),
            Self::Sha256 => Box::new(Sha256::new()),
        }
    }
}

/// What a part's bytes come to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Checksum {
    pub algorithm: ChecksumAlgorithm,
    pub sum: Vec<u8>,
}

/// A part being summed up.
pub struct ChecksumCheck {
    hasher: Box<dyn DynDigest + Send>,
    sum: Vec<u8>,
}

impl ChecksumCheck {
    pub fn of(Checksum { algorithm, sum }: Checksum) -> Self {
        Self { hasher: algorithm.hasher(), sum }
    }

    pub fn take(&mut self, chunks: &[Bytes]) {
        chunks.iter().for_each(|chunk| self.hasher.update(chunk));
    }

    pub fn holds(self) -> bool {
        *self.hasher.finalize() == *self.sum
    }
}
