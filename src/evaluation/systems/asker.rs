//! A vision-language model, asked from threads that know of no runtime.

use crate::evaluation::configuration::Configuration;
use crate::geometry::boxes::Aabb;
use crate::grounding::Grounding;
use crate::grounding::query::{ParsedQuery, QueryParser, VlmParser};
use crate::grounding::vlm::{
    Brief, Conversation, Decision, EvidenceMode, Exhibits, MAX_CALLS, Options, Outcome, PictureSettings, Undecided, collages, decide,
    global, naming, reasoner_name,
};
use crate::ingest::Unpacked;
use crate::models::chat::{CallRecord, ChatClient, Picture, Purse, Session};
use crate::render::{Scenery, Shot, close_ups};
use crate::scene::{FrameRef, Instance, InstanceId};
use crate::scene_parsing::evidence;
use anyhow::{Context, bail};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use tokio::runtime::Runtime;

/// A model, and what may be spent on it in this run.
pub(super) struct Asker {
    client: Arc<ChatClient>,
    purses: Vec<Purse>,
    json: bool,
    runtime: Runtime,
}

/// The photographs of a scene, and what has been made of them.
pub(super) struct Album {
    frames: Vec<FrameRef>,
    /// Where the frames lie; a temporary folder goes with it.
    _folder: Option<Unpacked>,
    /// By instance, full and frugal.
    collages: Mutex<BTreeMap<(u32, usize), Picture>>,
    names: Mutex<BTreeMap<u32, String>>,
}

impl Album {
    pub fn new(frames: Vec<FrameRef>, folder: Option<Unpacked>) -> Self {
        Self { frames, _folder: folder, collages: Mutex::default(), names: Mutex::default() }
    }

    fn shots(&self, instance: &Instance, scenery: &Scenery) -> Vec<Shot> {
        let shot = |view: &crate::scene::View| {
            let frame = self.frames.iter().find(|frame| frame.index == view.frame)?.decode_color().ok()?;
            Some(Shot::new(evidence::crop(&frame, view), frame, view.box_px))
        };
        let shots: Vec<Shot> = instance.views.iter().filter_map(shot).collect();
        if shots.is_empty() && !scenery.cloud.is_empty() { close_ups(scenery, &instance.aabb) } else { shots }
    }
}

/// A scene as the model is shown it.
pub(super) struct Room<'a> {
    pub instances: &'a [Instance],
    pub scenery: &'a Scenery,
    pub extent: Aabb,
    pub album: &'a Album,
}

impl Room<'_> {
    fn shots(&self, id: InstanceId) -> Vec<Shot> {
        self.instances.get(id.0 as usize - 1).map_or_else(Vec::new, |i| self.album.shots(i, self.scenery))
    }
}

impl Asker {
    pub fn new(client: ChatClient, max_usd: Option<f64>, json: bool) -> anyhow::Result<Self> {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
        let purses = max_usd.map(|usd| Purse::new("this run", usd)).into_iter().collect();
        Ok(Self { client: Arc::new(client), purses, json, runtime })
    }

    fn parser(&self) -> VlmParser {
        VlmParser { client: self.client.clone(), purses: self.purses.clone() }
    }

    pub fn parser_name(&self) -> String {
        self.parser().name()
    }

    /// Reads a question. A call that failed is no answer of the configuration: it is told, counted as wrong, and asked again next time.
    pub fn read(&self, query: &str) -> anyhow::Result<(ParsedQuery, Vec<CallRecord>)> {
        let reading = self.runtime.block_on(self.parser().read(query));
        let answered = reading.calls.iter().any(|call| call.outcome.is_ok());
        if let Some(why) = reading.fell_back.filter(|_| !answered) {
            bail!("the model could not be asked: {why}");
        }
        Ok((reading.parsed, reading.calls))
    }

    /// Lets the model decide. Its name comes back unless it never said anything that can be used, and the geometry's answer stands.
    pub fn review(
        &self,
        room: &Room,
        brief: &Brief,
        grounding: &mut Grounding,
        configuration: &Configuration,
    ) -> anyhow::Result<(Vec<CallRecord>, Option<String>)> {
        let options = Options { ablation: configuration.ablation, evidence: configuration.evidence, json: self.json };
        let uses_names = options.evidence == EvidenceMode::CachedNames;
        let names: BTreeMap<u32, String> = match uses_names {
            true => {
                let known = room.album.names.lock().unwrap_or_else(PoisonError::into_inner);
                known
                    .iter()
                    .filter(|(id, _)| brief.is_candidate(**id))
                    .map(|(id, name)| (*id, name.clone()))
                    .collect()
            }
            false => BTreeMap::new(),
        };
        let exhibits = exhibits(room, brief, &PictureSettings::of(options.evidence));
        let unnamed = brief.unnamed(&names, options.evidence);
        // What nobody can see is not asked about.
        let shots: Vec<_> = unnamed.iter().filter_map(|id| Some((*id, room.shots(*id).into_iter().next()?))).collect();
        let unnamed = (!shots.is_empty()).then(|| (naming::sheet(1, &shots), shots.iter().map(|(id, _)| id.0).collect()));
        let conversation = Conversation { brief, exhibits: &exhibits, options, names, unnamed };
        let mut session = Session::new(&self.client, self.purses.clone(), MAX_CALLS);
        let decision = self.runtime.block_on(decide(&conversation, &mut session));
        let (Ok(Decision { new_names, .. }) | Err(Undecided { new_names, .. })) = &decision;
        room.album.names.lock().unwrap_or_else(PoisonError::into_inner).extend(new_names.clone());
        let decision = decision.context("the model could not be asked")?;
        decision.apply(grounding, brief, room.instances);
        let decided = decision.outcome != Outcome::Unknown;
        Ok((session.into_records(), decided.then(|| reasoner_name(self.client.model()))))
    }
}

fn exhibits(room: &Room, brief: &Brief, settings: &PictureSettings) -> Exhibits {
    let shots_each = settings.collage.max_shots;
    let known = || room.album.collages.lock().unwrap_or_else(PoisonError::into_inner);
    let missing: Vec<InstanceId> = {
        let known = known();
        brief
            .candidates
            .iter()
            .map(|c| c.id)
            .filter(|id| !known.contains_key(&(id.0, shots_each)))
            .collect()
    };
    // Drawn without the lock: whoever waits here may be given another question to work on, which would wait for it for ever.
    let drawn = collages(&missing, |id| room.shots(id), settings.collage);
    let mut known = known();
    known.extend(drawn.into_iter().map(|(id, picture)| ((id, shots_each), picture)));
    let of_candidates = brief.candidates.iter().filter_map(|c| Some((c.id.0, known.get(&(c.id.0, shots_each))?.clone())));
    let collages = of_candidates.collect();
    drop(known);
    Exhibits { global: global(brief, room.scenery, &room.extent, &settings.global), collages }
}
