//! Cuts flat things out of the superpoints of the planes they lie on ([`planes::flat_things`]).
//!
//! [`planes::flat_things`]: crate::planes::flat_things

use super::ParseError;
use super::consensus::MaskedFrames;
use super::consensus::clusters::MaskCluster;
use super::consensus::cuts;
use super::consensus::observations::MaskObservations;
use super::lifting::FrameVisibility;
use super::planes::{Planes, flat_things};
use super::superpoints::Superpoints;
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::FrameIndex;

/// Superpoints, the planes they lie on, and what the frames see of them.
pub struct SuperpointsAndPlanes {
    /// The superpoints.
    pub superpoints: Superpoints,
    /// The planes. Superpoints of flat things are on none.
    pub planes: Planes,
    /// What the frames see of the superpoints.
    pub tables: Vec<FrameVisibility>,
}

/// Finds flat things and gives them superpoints of their own.
///
/// # Errors
/// [`ParseError`]: an unreadable frame, or cancellation.
pub fn separate_flat_things(
    seen: MaskedFrames,
    before: SuperpointsAndPlanes,
    progress: &Progress,
) -> Result<SuperpointsAndPlanes, ParseError> {
    let MaskedFrames { cloud, visibility, frames, masks_of } = seen;
    let SuperpointsAndPlanes { superpoints, planes, tables } = before;
    let cameras = super::camera_centers(frames);
    let things = flat_things::find(cloud, &superpoints, &planes, &cameras, progress)?;
    if things.is_empty() {
        return Ok(SuperpointsAndPlanes { superpoints, planes, tables });
    }
    let observations =
        MaskObservations::collect(cloud.len(), visibility, frames, masks_of, progress)?;
    let sampled = |points: &Vec<u32>| MaskCluster {
        samples: points.iter().filter_map(|&p| MaskObservations::sample(p as usize)).collect(),
        masks: 0,
    };
    let clusters: Vec<MaskCluster> = things.iter().map(sampled).collect();
    let indices: Vec<FrameIndex> = frames.iter().map(|frame| frame.index).collect();
    let cut =
        cuts::cut_superpoints(cloud, &superpoints, (&tables, &indices, &observations), &clusters);
    let mut of_superpoint = cut.extend(&planes.of_superpoint);
    let mut flat_thing_of = vec![None; of_superpoint.len()];
    for (thing, members) in (0..).zip(&cut.clusters) {
        for &s in members {
            of_superpoint[s as usize] = None;
            flat_thing_of[s as usize] = Some(thing);
        }
    }
    let planes = Planes { planes: planes.planes, of_superpoint, flat_thing_of };
    Ok(SuperpointsAndPlanes { superpoints: cut.superpoints, planes, tables: cut.tables })
}
