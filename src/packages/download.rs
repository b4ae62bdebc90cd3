//! Downloads an archive from its registry to a file, and verifies it during the download.

use super::{Event, FetchError, Package, Registries, describe_error};
use crate::packages::unpack::hex;
use reqwest::blocking::Client;
use sha2::{Digest, Sha256};
use std::fs::File;
use std::io::{Read, Seek, Write};
use std::time::Duration;
use uniground_client::install_crypto_provider;

/// Timeout for connecting to a registry, for its response, and between two chunks of an archive.
const NETWORK_TIMEOUT: Duration = Duration::from_mins(1);
const CONNECT: Duration = Duration::from_secs(15);
/// Number of bytes that are read at once.
const PIECE_BYTES: usize = 1 << 16;

/// Streams a package's archive into `to`. The file is at its start afterwards.
///
/// # Errors
/// Returns an error when the registry is unreachable or does not have the archive, or when the
/// archive is truncated or differs from the expected one.
pub fn download_archive(
    package: &Package,
    registries: &Registries,
    to: &mut File,
    on_event: &mut dyn FnMut(Event),
) -> Result<(), FetchError> {
    install_crypto_provider();
    let registry = registries.registry_of(package);
    let broken = |why: String| registry.unreachable(package, why);
    let client = Client::builder()
        .timeout(NETWORK_TIMEOUT)
        .connect_timeout(CONNECT)
        .build()
        .map_err(|e| broken(describe_error(e)))?;
    let address = registry.address_of(package, &client)?;
    let answer = client.get(address).send().and_then(reqwest::blocking::Response::error_for_status);
    // One byte more than expected, to detect an archive that is too long.
    let mut body = answer.map_err(|e| broken(describe_error(e)))?.take(package.bytes + 1);
    on_event(Event::Started(package.to_string(), package.bytes));
    let (mut sum, mut piece, mut received) = (Sha256::new(), vec![0; PIECE_BYTES], 0);
    loop {
        let read = body
            .read(&mut piece)
            .map_err(|e| broken(format!("the download was interrupted: {e}")))?;
        if read == 0 {
            break;
        }
        sum.update(&piece[..read]);
        to.write_all(&piece[..read])
            .map_err(|e| broken(format!("the download cannot be written to disk: {e}")))?;
        received += read as u64;
        on_event(Event::Received(received));
    }
    if received != package.bytes {
        return Err(FetchError::WrongSize {
            package: package.to_string(),
            expected: package.bytes,
        });
    }
    let found = hex(sum);
    if found != package.sha256 {
        let (package, what, expected) = (package.to_string(), "the archive".into(), package.sha256);
        return Err(FetchError::WrongHash { package, what, found, expected });
    }
    to.rewind().map_err(|e| broken(format!("the download cannot be read from disk: {e}")))
}
