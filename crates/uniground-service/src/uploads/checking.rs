//! Checks received bytes against the checksum of their sender.

use bytes::Bytes;
use sha1::Sha1;
use sha2::digest::DynDigest;
use sha2::{Digest, Sha256};

/// The hash function of a checksum.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ChecksumAlgorithm {
    /// For clients without SHA-256. Detects damage in transit, not tampering.
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

/// The expected checksum of a part.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Checksum {
    pub algorithm: ChecksumAlgorithm,
    pub sum: Vec<u8>,
}

/// Computes the checksum of a part while it is received.
pub struct ChecksumCheck {
    hasher: Box<dyn DynDigest + Send>,
    sum: Vec<u8>,
}

impl ChecksumCheck {
    pub fn new(Checksum { algorithm, sum }: Checksum) -> Self {
        Self { hasher: algorithm.hasher(), sum }
    }

    pub fn update(&mut self, chunks: &[Bytes]) {
        chunks.iter().for_each(|chunk| self.hasher.update(chunk));
    }

    pub fn matches(self) -> bool {
        *self.hasher.finalize() == *self.sum
    }
}
