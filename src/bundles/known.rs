//! Models at the hub that are known by name.

use serde::Serialize;
use uniground_core::models::neural::Role;

/// A repository at the hub with networks in a supported layout.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct KnownModel {
    /// `hub:OWNER/NAME`.
    pub source: &'static str,
    pub role: Role,
    /// Millions of parameters of the networks that are used.
    pub parameters_m: f32,
    /// License of the weights, as their authors state it.
    pub license: &'static str,
    /// What was tested: `layout`, with random weights written by the same exporter, or `weights`.
    pub tested: &'static str,
    /// What speaks for it, for people.
    pub note: &'static str,
}

impl KnownModel {
    /// Returns the size with this many bytes for each parameter, without tokenizer.
    #[must_use]
    pub fn megabytes(&self, bytes_per_parameter: f32) -> f32 {
        self.parameters_m * bytes_per_parameter
    }
}

const LAYOUT: &str = "layout";

/// Repositories that are published in these layouts.
pub const KNOWN: &[KnownModel] = &[
    KnownModel {
        source: "hub:Xenova/clip-vit-base-patch32",
        role: Role::Encoder,
        parameters_m: 151.0,
        license: "MIT",
        tested: LAYOUT,
        note: "CLIP, the fastest",
    },
    KnownModel {
        source: "hub:Xenova/clip-vit-base-patch16",
        role: Role::Encoder,
        parameters_m: 150.0,
        license: "MIT",
        tested: LAYOUT,
        note: "CLIP, smaller patches",
    },
    KnownModel {
        source: "hub:Xenova/clip-vit-large-patch14",
        role: Role::Encoder,
        parameters_m: 428.0,
        license: "MIT",
        tested: LAYOUT,
        note: "CLIP, large; for a GPU",
    },
    KnownModel {
        source: "hub:Xenova/siglip-base-patch16-224",
        role: Role::Encoder,
        parameters_m: 203.0,
        license: "Apache-2.0",
        tested: LAYOUT,
        note: "SigLIP",
    },
    KnownModel {
        source: "hub:onnx-community/siglip2-base-patch16-224-ONNX",
        role: Role::Encoder,
        parameters_m: 375.0,
        license: "Apache-2.0",
        tested: LAYOUT,
        note: "SigLIP 2, many languages",
    },
    KnownModel {
        source: "hub:Acly/MobileSAM",
        role: Role::Masks,
        parameters_m: 10.0,
        license: "Apache-2.0",
        tested: LAYOUT,
        note: "MobileSAM",
    },
    KnownModel {
        source: "hub:Xenova/slimsam-77-uniform",
        role: Role::Masks,
        parameters_m: 9.8,
        license: "Apache-2.0",
        tested: LAYOUT,
        note: "SlimSAM, the smallest",
    },
    KnownModel {
        source: "hub:onnx-community/EdgeTAM-ONNX",
        role: Role::Masks,
        parameters_m: 14.0,
        license: "Apache-2.0",
        tested: LAYOUT,
        note: "EdgeTAM",
    },
    KnownModel {
        source: "hub:onnx-community/sam2.1-hiera-tiny-ONNX",
        role: Role::Masks,
        parameters_m: 39.0,
        license: "Apache-2.0",
        tested: LAYOUT,
        note: "SAM 2.1 tiny",
    },
    KnownModel {
        source: "hub:Xenova/sam-vit-base",
        role: Role::Masks,
        parameters_m: 94.0,
        license: "Apache-2.0",
        tested: LAYOUT,
        note: "SAM base",
    },
    KnownModel {
        source: "hub:onnx-community/sam2.1-hiera-large-ONNX",
        role: Role::Masks,
        parameters_m: 224.0,
        license: "Apache-2.0",
        tested: LAYOUT,
        note: "SAM 2.1 large; for a GPU",
    },
    KnownModel {
        source: "hub:onnx-community/sam3-tracker-ONNX",
        role: Role::Masks,
        parameters_m: 460.0,
        license: "SAM License",
        tested: LAYOUT,
        note: "SAM 3; for a GPU",
    },
];
