//! A parse that continues a previous one. In a scene that has grown, instances that stay keep their
//! ids, names and corrections.

use super::{ParseFile, read_frames};
use crate::ParseRunner;
use crate::error::Error;
use std::fs::File;
use std::io::BufReader;
use tokio::task::spawn_blocking;
use uniground_geometry::Isometry3;
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::{
    FrameRef, Instance, InstanceId, Owners, PointCloud, correct, read_instance_of_point,
};
use uniground_parsing::changes::{
    Counterparts, RoomState, carry_over_corrections, compare, compare_parses, continue_ids,
    match_things,
};
use uniground_parsing::scan::ParsedScan;
use uniground_storage::{Blobs, PinnedPath};
use uniground_types::changes::Changes;
use uniground_types::corrections::Correction;
use uniground_types::settings::InstanceSettings;

/// The previous parse of a scene.
pub(super) struct PreviousParse {
    pub parse_id: String,
    /// Whether it is a draft of the same scan.
    pub is_draft: bool,
    /// The instances as that parse found them, with those added since.
    found: Vec<Instance>,
    /// The instances with their names and with corrections applied.
    shown: Vec<Instance>,
    corrections: Vec<Correction>,
    blobs: Blobs,
    folder: PinnedPath,
    content: PinnedPath,
}

/// What the new parse takes over from the previous one.
pub(super) struct InheritedState {
    pub parse_id: String,
    /// Whether the previous parse was a draft of the same scan.
    pub from_draft: bool,
    pub changes: Changes,
    pub corrections: Vec<Correction>,
}

impl ParseRunner {
    /// Loads the parse that the next one continues.
    pub(super) async fn previous_parse(
        &self,
        parse_id: String,
        is_draft: bool,
    ) -> Result<PreviousParse, Error> {
        let loaded = self.parsed_scenes.loaded_parse(&parse_id).await?;
        let (blobs, folder, content) =
            (self.blobs.clone(), self.blobs.parse(&parse_id), loaded.content.clone());
        let brought = spawn_blocking(move || {
            Ok::<_, Error>((blobs.pin_folder(&folder)?, blobs.pin_folder(&content)?))
        });
        let (folder, content) = brought.await??;
        Ok(PreviousParse {
            found: self.parse_repository.instances(&parse_id).await?,
            shown: loaded.instances.clone(),
            corrections: self.correction_repository.corrections(&parse_id).await?,
            blobs: self.blobs.clone(),
            folder,
            content,
            parse_id,
            is_draft,
        })
    }
}

impl PreviousParse {
    /// Gives a new parse the ids of this one and returns what changed. Blocks.
    ///
    /// # Errors
    /// Unreadable frames; cancellation.
    pub fn continue_in(
        self,
        scan: &mut ParsedScan,
        settings: &InstanceSettings,
        progress: &Progress,
    ) -> Result<InheritedState, Error> {
        let points = self.points();
        let (corrections, counterparts) = self.carry_over(points.as_ref(), scan, settings);
        if self.is_draft {
            let mut now = scan.scene.instances.clone();
            correct(&mut now, &corrections);
            let changes = compare_parses(&self.shown, &now);
            return Ok(InheritedState {
                parse_id: self.parse_id,
                from_draft: true,
                changes,
                corrections,
            });
        }
        let (Some((cloud, of_point)), Some(counterparts)) = (points, counterparts) else {
            return Ok(InheritedState {
                parse_id: self.parse_id,
                from_draft: false,
                changes: Changes::default(),
                corrections,
            });
        };
        let mut now = scan.scene.instances.clone();
        correct(&mut now, &corrections);
        let frames_before =
            read_frames(&self.blobs, &self.folder, &self.content)?.unwrap_or_default();
        let is_new =
            |frame: &&FrameRef| frames_before.iter().all(|before| before.index != frame.index);
        let new_frames: Vec<FrameRef> = scan.frames.iter().filter(is_new).cloned().collect();
        let owner_before = point_owners(&self.shown, &of_point, &cloud);
        let owner_now = point_owners(&now, &scan.scene.instance_of_point, &scan.scene.cloud);
        let stayed =
            self.shown.iter().zip(&now).filter(|(before, now)| before.is_shown() && now.is_shown());
        let stayed: Vec<(InstanceId, InstanceId)> =
            stayed.map(|(before, now)| (before.id, now.id)).collect();
        let changes = compare(
            &RoomState {
                cloud: &cloud,
                owner_of_point: &owner_before,
                instances: &self.shown,
                frames: &frames_before,
            },
            &RoomState {
                cloud: &scan.scene.cloud,
                owner_of_point: &owner_now,
                instances: &now,
                frames: &new_frames,
            },
            &stayed,
            &counterparts,
            &Isometry3::identity(),
            progress,
        )?;
        Ok(InheritedState { parse_id: self.parse_id, from_draft: false, changes, corrections })
    }

    /// Gives a new parse the ids of this one. Returns the corrections that still apply, and which
    /// points of both clouds are the same.
    fn carry_over(
        &self,
        points: Option<&(PointCloud, Vec<InstanceId>)>,
        scan: &mut ParsedScan,
        settings: &InstanceSettings,
    ) -> (Vec<Correction>, Option<Counterparts>) {
        let counterparts = points.map(|(cloud, _)| {
            Counterparts::match_identical(&cloud.positions, &scan.scene.cloud.positions)
        });
        let same = if let (Some((_, of_point)), Some(counterparts)) = (points, &counterparts) {
            match_things(of_point, &scan.scene.instance_of_point, counterparts)
        } else {
            tracing::warn!(
                parse_id = self.parse_id,
                "files of the previous parse could not be read; matching instances by their boxes"
            );
            identical_instances(&self.found, &scan.scene.instances)
        };
        scan.scene = continue_ids(&self.found, scan.scene.clone(), &same);
        (carry_over_corrections(&self.corrections, &mut scan.scene, settings), counterparts)
    }

    fn points(&self) -> Option<(PointCloud, Vec<InstanceId>)> {
        let cloud = uniground_ingest::read_cloud(&ParseFile::Cloud.path_in(&self.folder)).ok()?;
        let file = File::open(ParseFile::Instances.path_in(&self.folder)).ok()?;
        let of_point = read_instance_of_point(BufReader::new(file)).ok()?;
        (of_point.len() == cloud.len()).then_some((cloud, of_point))
    }
}

/// Returns pairs of instances whose boxes, point counts and levels are identical to the bit.
fn identical_instances(before: &[Instance], now: &[Instance]) -> Vec<(InstanceId, InstanceId)> {
    let is_same = |a: &Instance, b: &Instance| {
        !a.gone && a.raw_box == b.raw_box && a.point_count == b.point_count && a.level == b.level
    };
    let pair =
        |new: &Instance| before.iter().find(|old| is_same(old, new)).map(|old| (old.id, new.id));
    now.iter().filter_map(pair).collect()
}

/// Returns the owner of each point, with corrections applied.
fn point_owners(
    instances: &[Instance],
    of_point: &[InstanceId],
    cloud: &PointCloud,
) -> Vec<InstanceId> {
    let owners = Owners::new(of_point, instances);
    of_point
        .iter()
        .zip(&cloud.positions)
        .map(|(found, position)| owners.owner_of(*found, position))
        .collect()
}
