//! Finds the most likely scenes for a question about many. An index stores what rooms contain. It
//! is used when a question covers more rooms than can be scanned one by one.

use crate::error::Error;
use crate::{ParsedScenes, QuestionPermits, ServiceLocks};
use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::Mutex;
use tokio::task::spawn_blocking;
use uniground_geometry::color::ColorName;
use uniground_grounding::GivenName;
use uniground_grounding::room_index::{Sought, entries};
use uniground_models::neural::{Models, Role};
use uniground_storage::{
    ParseRepository, ParseToIndex, RoomEntry, RoomIndexRepository, RoomMatch, RoomVectors,
    SceneFilter, SceneRepository, SceneRow,
};
use uniground_types::labels::Labels;

/// Rooms read for indexing at once.
const ROOMS_PER_ROUND: u32 = 64;
/// The pause between two rooms, so that indexing does not slow down other work.
const PAUSE: Duration = Duration::from_millis(10);
/// The names looked up for each object in a question: those that fit it best.
const NAMES: usize = 32;
/// The rooms looked up for each name: those with the highest weight.
const ROOMS: u32 = 512;
/// The maximum number of scenes with the same parse that are scanned.
const MAX_SCENES_PER_PARSE: u32 = 20;
/// The maximum age of the list of names.
const AGE: Duration = Duration::from_secs(10);

/// All names of instances in rooms. The grammar reads each of them once.
#[derive(Default)]
pub(super) struct RoomNames(Mutex<Option<(Instant, Arc<Names>)>>);

type Names = HashMap<String, GivenName>;

/// Finds the scenes that are likely to contain what a question names.
#[derive(Clone)]
pub struct RoomSearch {
    pub(crate) room_index_repository: RoomIndexRepository,
    pub(crate) parse_repository: ParseRepository,
    pub(crate) service_locks: Arc<ServiceLocks>,
    pub(crate) parsed_scenes: Arc<ParsedScenes>,
    pub(crate) scene_repository: SceneRepository,
    pub(crate) question_permits: QuestionPermits,
    pub(crate) room_names: Arc<RoomNames>,
    pub(crate) models: Models,
}

impl RoomSearch {
    /// Indexes rooms that are new or have changed. One process does this for all.
    ///
    /// # Errors
    /// [`Error`] of the store. Rooms that were indexed stay indexed.
    pub async fn index_rooms(&self) -> Result<(), Error> {
        let mut wanted = self.room_index_repository.parses_to_index(ROOMS_PER_ROUND).await?;
        if wanted.is_empty() {
            return Ok(());
        }
        let Some(index_lock) = self.service_locks.try_lock_room_index().await? else {
            return Ok(());
        };
        while !wanted.is_empty() && index_lock.is_ours() {
            for room in &wanted {
                match self.index_room(room).await {
                    Ok(()) => {}
                    // The parse was deleted in the meantime.
                    Err(_)
                        if self
                            .parse_repository
                            .changes_of_parse(&room.parse_id)
                            .await?
                            .is_none() => {}
                    // The database, the object store or the disk is unavailable now. The room is
                    // indexed later.
                    Err(error)
                        if error.is_disk_full()
                            || ["storage_busy", "blobs_busy"].contains(&error.code()) =>
                    {
                        return Err(error);
                    }
                    // A damaged room must not block the others.
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
            wanted = self.room_index_repository.parses_to_index(ROOMS_PER_ROUND).await?;
        }
        Ok(())
    }

    async fn index_room(&self, room: &ParseToIndex) -> Result<(), Error> {
        let parse = self.parsed_scenes.load_parse_uncached(&room.parse_id).await?;
        let keeps_vectors = self.room_index_repository.has_vectors().await?;
        let (known, seen) = spawn_blocking(move || {
            let known = entries(&parse.instances).into_iter();
            let known = known.map(|entry| RoomEntry {
                name: entry.name,
                color: entry.color.map_or("", ColorName::as_str),
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
        self.room_index_repository.insert_vectors(&room.parse_id, seen.as_ref()).await?;
        Ok(self.room_index_repository.index_room(room, &known).await?)
    }

    /// Returns the scenes with these labels that most likely contain what a question asks for, the
    /// likeliest first. Returns at most `most` scenes.
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
            for (name, fit) in self.best_fitting_names(&sought, at).await? {
                for RoomMatch { parse_id, color, weight } in
                    self.rooms_with(&name, sought.colors(at), labels).await?
                {
                    let counts = sought.weigh_entry(
                        at,
                        fit,
                        ColorName::ALL.into_iter().find(|known| known.as_str() == color),
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
        // Alternates between rooms by name and by appearance: their scores cannot be compared.
        let by_looks = self.rooms_by_appearance(&sought, labels, most).await?;
        let mut chosen: Vec<String> = Vec::new();
        for room in interleave(by_name, by_looks.into_iter()) {
            if chosen.len() >= most {
                break;
            }
            if !chosen.contains(&room) {
                chosen.push(room);
            }
        }
        if chosen.is_empty() {
            // Nothing matches, so the newest scenes are returned.
            let filter = SceneFilter { ids: None, labels: labels.clone() };
            return Ok(self.scene_repository.scenes(most as u32, None, &filter).await?);
        }
        let rank: HashMap<&str, usize> =
            chosen.iter().enumerate().map(|(rank, room)| (room.as_str(), rank)).collect();
        // A room that was uploaded many times must not crowd out the others.
        let scenes = self
            .room_index_repository
            .scenes_of_parses(&chosen, labels, MAX_SCENES_PER_PARSE)
            .await?;
        let rank_of =
            |scene: &SceneRow| scene.parse_id.as_deref().and_then(|parse| rank.get(parse).copied());
        let mut scenes: Vec<_> =
            scenes.into_iter().map(|(place, scene)| ((place, rank_of(&scene)), scene)).collect();
        scenes.sort_by_key(|(place, _)| *place);
        scenes.truncate(most);
        Ok(scenes.into_iter().map(|(_, scene)| scene).collect())
    }

    /// Returns the names that fit an object of the question best, with their fit.
    async fn best_fitting_names(
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

    /// Returns rooms that contain an instance with this name. If there are too many to return, adds
    /// those that have it in the requested colors.
    async fn rooms_with(
        &self,
        name: &str,
        colors: &[ColorName],
        labels: &Labels,
    ) -> Result<Vec<RoomMatch>, Error> {
        let mut found = self.room_index_repository.rooms_with(name, None, labels, ROOMS).await?;
        if found.len() >= ROOMS as usize {
            for color in colors {
                found.extend(
                    self.room_index_repository
                        .rooms_with(name, Some(color.as_str()), labels, ROOMS)
                        .await?,
                );
            }
        }
        Ok(found)
    }

    /// Returns rooms with an instance whose embedding matches the words, the likeliest first.
    /// Returns none if no embeddings are stored.
    async fn rooms_by_appearance(
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
        Ok(self.room_index_repository.nearest_rooms(&name, &vector, labels, most as u32).await?)
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

/// Alternates between two iterators until both are exhausted.
fn interleave<T>(
    mut one: impl Iterator<Item = T>,
    mut other: impl Iterator<Item = T>,
) -> impl Iterator<Item = T> {
    let mut take_one = false;
    std::iter::from_fn(move || {
        take_one = !take_one;
        if take_one {
            one.next().or_else(|| other.next())
        } else {
            other.next().or_else(|| one.next())
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn interleaving_continues_when_one_side_is_exhausted() {
        assert_eq!(
            interleave([1, 3, 5, 6].into_iter(), [2, 4].into_iter()).collect::<Vec<_>>(),
            [1, 2, 3, 4, 5, 6]
        );
        assert_eq!(interleave([].into_iter(), [2, 4].into_iter()).collect::<Vec<_>>(), [2, 4]);
    }
}
