//! Which of many rooms are worth a look: what they are known by is noted beside everything else,
//! and looked up when somebody asks about more rooms than can be looked into one by one.

use crate::error::Error;
use crate::{ParsedScenes, QuestionPermits, ServiceLocks};
use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::Mutex;
use tokio::task::spawn_blocking;
use uniground_geometry::colour::ColourName;
use uniground_grounding::GivenName;
use uniground_grounding::room_index::{Sought, entries};
use uniground_models::neural::{Models, Role};
use uniground_storage::{
    ParseRepository, ParseToIndex, RoomEntry, RoomIndexRepository, RoomMatch, RoomVectors,
    SceneFilter, SceneRepository, SceneRow,
};
use uniground_types::labels::Labels;

/// Rooms that are noted in one go.
const AT_ONCE: u32 = 64;
/// The pause between two of them: nobody shall notice.
const PAUSE: Duration = Duration::from_millis(10);
/// Names that are looked up for each thing a question speaks of: those that fit it best.
const NAMES: usize = 32;
/// Rooms that are looked up for each of them: those in which it is believed most.
const ROOMS: u32 = 512;
/// Scenes that have one parse in common, which are looked into at most.
const SAME_ROOM: u32 = 20;
/// How old the list of names may be.
const AGE: Duration = Duration::from_secs(10);

/// Every name that a room's thing has, read by the grammar once.
#[derive(Default)]
pub(super) struct RoomNames(Mutex<Option<(Instant, Arc<Names>)>>);

type Names = HashMap<String, GivenName>;

/// Finds the scenes that are likely to hold what a question names.
#[derive(Clone)]
pub struct RoomSearch {
    pub(crate) room_index_repository: RoomIndexRepository,
    pub(crate) parse_repository: ParseRepository,
    pub(crate) service_locks: ServiceLocks,
    pub(crate) parsed_scenes: ParsedScenes,
    pub(crate) scene_repository: SceneRepository,
    pub(crate) question_permits: QuestionPermits,
    pub(crate) room_names: Arc<RoomNames>,
    pub(crate) models: Models,
}

impl RoomSearch {
    /// Notes what rooms are known by that are new, or of which something else is known by now. One
    /// process does it for all.
    ///
    /// # Errors
    /// [`Error`] of the store; what was noted stays.
    pub async fn index_rooms(&self) -> Result<(), Error> {
        let mut wanted = self.room_index_repository.parses_to_index(AT_ONCE).await?;
        if wanted.is_empty() {
            return Ok(());
        }
        let Some(turn) = self.service_locks.indexing().await? else { return Ok(()) };
        while !wanted.is_empty() && turn.is_ours() {
            for room in &wanted {
                match self.index_room(room).await {
                    Ok(()) => {}
                    // It went meanwhile.
                    Err(_)
                        if self
                            .parse_repository
                            .changes_of_parse(&room.parse_id)
                            .await?
                            .is_none() => {}
                    // Its time comes: the database, the object store or the disk can not be used
                    // now.
                    Err(error)
                        if error.is_disk_full()
                            || ["storage_busy", "blobs_busy"].contains(&error.code()) =>
                    {
                        return Err(error);
                    }
                    // One that is damaged does not keep the others waiting.
                    Err(error) => {
                        tracing::warn!(
                            room.parse_id,
                            error = &error as &dyn std::error::Error,
                            "scene could not be indexed for search"
                        );
                        self.room_index_repository.index_room(room, &[]).await?;
                    }
                }
                tokio::time::sleep(PAUSE).await;
            }
            wanted = self.room_index_repository.parses_to_index(AT_ONCE).await?;
        }
        Ok(())
    }

    async fn index_room(&self, room: &ParseToIndex) -> Result<(), Error> {
        let parse = self.parsed_scenes.passing_parse(&room.parse_id).await?;
        let keeps_vectors = self.room_index_repository.has_vectors().await?;
        let (known, seen) = spawn_blocking(move || {
            let known = entries(&parse.instances).into_iter();
            let known = known.map(|entry| RoomEntry {
                name: entry.name,
                colour: entry.colour.map_or("", ColourName::word),
                weight: entry.weight,
            });
            let seen = parse.embeddings.as_ref().filter(|_| keeps_vectors).map(|embeddings| {
                let of_things = |&at: &usize| {
                    embeddings.is_seen(at)
                        && parse.instances.get(at).is_some_and(|i| i.structure.is_none())
                };
                let vectors =
                    (0..embeddings.len()).filter(of_things).map(|at| embeddings.row(at)).collect();
                RoomVectors { encoder: parse.encoder.clone(), vectors }
            });
            (known.collect::<Vec<_>>(), seen)
        })
        .await?;
        self.room_index_repository.keep_vectors(&room.parse_id, seen.as_ref()).await?;
        Ok(self.room_index_repository.index_room(room, &known).await?)
    }

    /// Of all scenes with these labels those that most likely have what a question asks for, at
    /// most so many, the likeliest first.
    pub(super) async fn likely_scenes(
        &self,
        query: &str,
        labels: &Labels,
        most: usize,
    ) -> Result<Vec<SceneRow>, Error> {
        let question = query.to_owned();
        let sought =
            Arc::new(self.question_permits.compute(move || Ok(Sought::of(&question))).await?);
        let mut rooms: HashMap<String, Vec<f32>> = HashMap::new();
        for at in 0..sought.len() {
            for (name, fit) in self.names_for(&sought, at).await? {
                for RoomMatch { parse_id, colour, weight } in
                    self.rooms_with(&name, sought.colours(at), labels).await?
                {
                    let counts = sought.weigh_entry(
                        at,
                        fit,
                        ColourName::ALL.into_iter().find(|known| known.word() == colour),
                        weight,
                    );
                    let best =
                        &mut rooms.entry(parse_id).or_insert_with(|| vec![0.0; sought.len()])[at];
                    *best = best.max(counts);
                }
            }
        }
        let mut likely: Vec<(f32, String)> =
            rooms.into_iter().map(|(room, found)| (sought.weigh_room(&found), room)).collect();
        likely.sort_by(|a, b| b.0.total_cmp(&a.0).then_with(|| b.1.cmp(&a.1)));
        let by_name = likely.into_iter().map(|(_, room)| room);
        // Names and looks have their say in turns: neither measures what the other does.
        let by_looks = self.rooms_that_look_so(&sought, labels, most).await?;
        let mut chosen: Vec<String> = Vec::new();
        for room in in_turns(by_name, by_looks.into_iter()) {
            if chosen.len() >= most {
                break;
            }
            if !chosen.contains(&room) {
                chosen.push(room);
            }
        }
        if chosen.is_empty() {
            // Nothing tells: the newest are as good as any.
            let filter = SceneFilter { ids: None, labels: labels.clone() };
            return Ok(self.scene_repository.scenes(most as u32, None, &filter).await?);
        }
        let rank: HashMap<&str, usize> =
            chosen.iter().enumerate().map(|(rank, room)| (room.as_str(), rank)).collect();
        // A room that was uploaded again and again does not keep the others out.
        let scenes =
            self.room_index_repository.scenes_of_parses(&chosen, labels, SAME_ROOM).await?;
        let rank_of =
            |scene: &SceneRow| scene.parse_id.as_deref().and_then(|parse| rank.get(parse).copied());
        let mut scenes: Vec<_> =
            scenes.into_iter().map(|(place, scene)| ((place, rank_of(&scene)), scene)).collect();
        scenes.sort_by_key(|(place, _)| *place);
        scenes.truncate(most);
        Ok(scenes.into_iter().map(|(_, scene)| scene).collect())
    }

    /// The names that fit a thing best, and how well.
    async fn names_for(
        &self,
        sought: &Arc<Sought>,
        at: usize,
    ) -> Result<Vec<(String, f32)>, Error> {
        let (names, sought) = (self.room_names.get(self).await?, sought.clone());
        let fits = self.question_permits.compute(move || {
            let fits = names
                .iter()
                .map(|(name, read)| (name.clone(), sought.fit(at, read)))
                .filter(|(_, fit)| *fit > 0.0);
            let mut fits: Vec<(String, f32)> = fits.collect();
            fits.sort_by(|a, b| b.1.total_cmp(&a.1).then_with(|| a.0.cmp(&b.0)));
            fits.truncate(NAMES);
            Ok(fits)
        });
        fits.await
    }

    /// Rooms that have something of a name; of those many have, those that have it in the colours
    /// asked for come first.
    async fn rooms_with(
        &self,
        name: &str,
        colours: &[ColourName],
        labels: &Labels,
    ) -> Result<Vec<RoomMatch>, Error> {
        let mut found = self.room_index_repository.rooms_with(name, None, labels, ROOMS).await?;
        if found.len() >= ROOMS as usize {
            for colour in colours {
                found.extend(
                    self.room_index_repository
                        .rooms_with(name, Some(colour.word()), labels, ROOMS)
                        .await?,
                );
            }
        }
        Ok(found)
    }

    /// Rooms with something that looks as the words say, the likeliest first; none where nobody has
    /// kept what encoders have seen.
    async fn rooms_that_look_so(
        &self,
        sought: &Arc<Sought>,
        labels: &Labels,
        most: usize,
    ) -> Result<Vec<String>, Error> {
        let (Some(encoder), Some(name)) =
            (self.models.encoder.clone(), self.models.label(Role::Encoder))
        else {
            return Ok(Vec::new());
        };
        if sought.is_empty() || !self.room_index_repository.has_vectors().await? {
            return Ok(Vec::new());
        }
        let words = sought.target.clone();
        let read = self.question_permits.compute(move || Ok(encoder.embed_name(&words)));
        let vector = match read.await? {
            Ok(read) => read.vector,
            Err(error) => {
                tracing::warn!(
                    error = &error as &dyn std::error::Error,
                    "vector search failed; choosing scenes by names only"
                );
                None
            }
        };
        let Some(vector) = vector else { return Ok(Vec::new()) };
        Ok(self.room_index_repository.rooms_near(&name, &vector, labels, most as u32).await?)
    }
}

impl RoomNames {
    async fn get(&self, service: &RoomSearch) -> Result<Arc<Names>, Error> {
        let mut kept = self.0.lock().await;
        let known = match &*kept {
            Some((at, names)) if at.elapsed() < AGE => return Ok(names.clone()),
            known => known.as_ref().map(|(_, names)| names.clone()).unwrap_or_default(),
        };
        let names = service.room_index_repository.room_names().await?;
        let read = spawn_blocking(move || {
            let read = |name: String| {
                let read = known.get(&name).cloned().or_else(|| GivenName::read(&name))?;
                Some((name, read))
            };
            Arc::new(names.into_iter().filter_map(read).collect::<Names>())
        });
        let names = read.await?;
        *kept = Some((Instant::now(), names.clone()));
        Ok(names)
    }
}

/// One of each, as long as there are.
fn in_turns<T>(
    mut one: impl Iterator<Item = T>,
    mut other: impl Iterator<Item = T>,
) -> impl Iterator<Item = T> {
    let mut turn = false;
    std::iter::from_fn(move || {
        turn = !turn;
        if turn { one.next().or_else(|| other.next()) } else { other.next().or_else(|| one.next()) }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn turns_go_on_when_one_has_no_more() {
        assert_eq!(
            in_turns([1, 3, 5, 6].into_iter(), [2, 4].into_iter()).collect::<Vec<_>>(),
            [1, 2, 3, 4, 5, 6]
        );
        assert_eq!(in_turns([].into_iter(), [2, 4].into_iter()).collect::<Vec<_>>(), [2, 4]);
    }
}
