//! The lexicon of indoor nouns, read from `lexicon.tsv` on first use.

use super::wordnet::{Kinship, WordNet};
use std::collections::HashMap;
use std::sync::LazyLock;

/// A closed range in meters.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Range {
    /// Lower end, inclusive.
    pub low: f32,
    /// Upper end, inclusive. At least `low`.
    pub high: f32,
}

/// The `WordNet` kind that house plants, such as tulips and ferns, belong to.
const PLANT: &str = "vascular plant";
/// Upper bound of the number of steps between two related words.
const MAX_STEPS: u32 = 10;
/// Sizes below this are treated as equal: thinner than a scan resolves.
const RESOLUTION_M: f32 = 0.03;

impl Range {
    /// Returns how far `value` lies outside, in natural logarithms of the ratio; 0 inside.
    #[must_use]
    pub fn misfit_log(&self, value: f32) -> f32 {
        let [low, high, value] = [self.low, self.high, value].map(|v| v.max(RESOLUTION_M));
        (low / value).ln().max((value / high).ln()).max(0.0)
    }

    /// Returns the distance of `value` from the middle: 0 there, 1 at the ends and beyond; in
    /// logarithms.
    #[must_use]
    pub fn off_center(&self, value: f32) -> f32 {
        let [low, high, value] = [self.low, self.high, value].map(|v| v.max(RESOLUTION_M).ln());
        let half = (high - low) / 2.0;
        if half <= 0.0 { 0.0 } else { ((value - f32::midpoint(low, high)) / half).abs().min(1.0) }
    }

    /// Returns how far `value` lies outside, meters; 0 inside.
    #[must_use]
    pub fn misfit(&self, value: f32) -> f32 {
        (self.low - value).max(value - self.high).max(0.0)
    }

    fn spread_log(&self) -> f32 {
        (self.high.max(RESOLUTION_M) / self.low.max(RESOLUTION_M)).ln()
    }
}

/// The place where a thing rests.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Place {
    /// Directly on the floor.
    Floor,
    /// On another thing: a cup on a table.
    Surface,
    /// On a wall or the ceiling.
    Wall,
    /// On legs, which a scan often misses: the top can appear to float.
    Legs,
    /// No support was found. Every noun is compatible with that.
    Unknown,
}

/// The surface of a thing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shape {
    /// One plane: rugs, doors, screens.
    Flat,
    /// Closed and box-like.
    Boxy,
    /// Frames, legs and gaps.
    Open,
    /// Cylinders, balls, bowls.
    Round,
    /// Plants.
    Bushy,
    /// Bags, clothes, pillows.
    Soft,
}

/// One entry of the lexicon.
#[derive(Debug, Clone, PartialEq)]
pub struct Noun {
    /// Lowercase, singular, without hyphens and apostrophes. Unique among the entries.
    pub name: String,
    /// Other words for exactly this thing. Each belongs to one entry only.
    pub synonyms: Vec<String>,
    /// Broader words that also mean this thing.
    pub kinds: Vec<String>,
    /// Longer side of the footprint.
    pub long: Range,
    /// Shorter side of the footprint.
    pub short: Range,
    /// From underside to top. For a top on legs, from the floor to the top.
    pub height: Range,
    /// Height of the underside above the floor.
    pub base: Range,
    places: Vec<Place>,
    /// The usual surface. Compared with an instance's planarity and share of green points.
    pub shape: Shape,
    /// Nouns it usually stands on or hangs on, most common first; also `floor`, `wall`, `ceiling`.
    pub usually_on: Vec<String>,
    /// What people do with it: "sit on", "write with".
    pub uses: Vec<String>,
    /// How common such a thing is, `0..=1`, relative to the most common ones.
    pub prior: f32,
}

impl Noun {
    /// Returns whether it can rest there. True for an unknown place, and for things on legs.
    #[must_use]
    pub fn stands_on(&self, place: Place) -> bool {
        place == Place::Unknown || self.is_on_legs() || self.places.contains(&place)
    }

    /// Returns whether its height is measured from the floor to the top.
    #[must_use]
    pub fn is_on_legs(&self) -> bool {
        self.places.contains(&Place::Legs)
    }

    /// Returns whether it is often merged into one plane with its wall: doors, windows and
    /// pictures.
    #[must_use]
    pub fn can_be_part_of_wall(&self) -> bool {
        self.places.contains(&Place::Wall) && self.short.low <= RESOLUTION_M
    }

    /// Returns how specific its ranges are, `0.5..=1`.
    #[must_use]
    pub fn specificity(&self) -> f32 {
        let spread = self.long.spread_log() + self.short.spread_log() + self.height.spread_log();
        0.5 + 0.5 / (1.0 + 0.3 * spread)
    }
}

/// All nouns and all words that refer to them.
pub struct Lexicon {
    nouns: Vec<Noun>,
    by_word: HashMap<String, Vec<usize>>,
    longest_words: usize,
}

impl Lexicon {
    /// Returns the lexicon. It is loaded once per process.
    #[must_use]
    pub fn get() -> &'static Self {
        static LEXICON: LazyLock<Lexicon> =
            LazyLock::new(|| Lexicon::read(include_str!("lexicon.tsv")));
        &LEXICON
    }

    /// Returns all entries, in the order of `lexicon.tsv`.
    #[must_use]
    pub fn nouns(&self) -> &[Noun] {
        &self.nouns
    }

    /// Returns the noun that a word names directly or as a synonym. Plurals are recognized.
    #[must_use]
    pub fn find(&self, word: &str) -> Option<&Noun> {
        self.find_all(word).into_iter().next()
    }

    /// Returns every noun a word can mean, the direct one first: "chair" means chairs, office
    /// chairs and armchairs.
    #[must_use]
    pub fn find_all(&self, word: &str) -> Vec<&Noun> {
        singulars(word)
            .iter()
            .find_map(|w| self.by_word.get(w))
            .map_or_else(Vec::new, |ids| ids.iter().map(|&i| &self.nouns[i]).collect())
    }

    /// Returns nouns for a word that is not in the lexicon: the nouns it is a kind of, or else
    /// those that are kinds of it; the nearest and most common first.
    #[must_use]
    pub fn related_nouns(&self, word: &str) -> Vec<&Noun> {
        static KINDS: LazyLock<Vec<&[u32]>> = LazyLock::new(|| {
            Lexicon::get().nouns.iter().map(|noun| WordNet::get().kinds_of(&noun.name)).collect()
        });
        let of_word = WordNet::get().kinds_of(word);
        if of_word.is_empty() {
            return Vec::new();
        }
        let kin = |kinds: &[u32]| match WordNet::get().relation_of_kinds(of_word, kinds)? {
            Kinship::Same => Some(0),
            Kinship::Narrower(steps) => Some(steps),
            Kinship::Broader(steps) => Some(MAX_STEPS + steps),
        };
        let of_nouns = self.nouns.iter().zip(KINDS.iter());
        let mut akin: Vec<(u32, &Noun)> =
            of_nouns.filter_map(|(noun, kinds)| Some((kin(kinds)?, noun))).collect();
        akin.sort_by(|a, b| a.0.cmp(&b.0).then(b.1.prior.total_cmp(&a.1.prior)));
        let nearest = akin.first().map_or(0, |(steps, _)| *steps);
        let alike = |steps: u32| steps == nearest || nearest > MAX_STEPS;
        akin.into_iter().filter(|(steps, _)| alike(*steps)).map(|(_, noun)| noun).collect()
    }

    /// Returns nouns for containers that are named after their contents or that hold plants: a
    /// bottle for "the wine", a vase for "the tulips". The most common come first.
    #[must_use]
    pub fn container_nouns(&self, word: &str) -> Vec<&Noun> {
        let names = |noun: &Noun| {
            std::iter::once(&noun.name).chain(&noun.synonyms).cloned().collect::<Vec<_>>()
        };
        let called_after = |noun: &&Noun| {
            let container = noun.kinds.iter().any(|kind| kind == "container");
            container
                && names(noun).iter().any(|name| {
                    name.strip_prefix(word).is_some_and(|rest| {
                        rest.strip_prefix(' ').is_some_and(|container| self.is_known(container))
                    })
                })
        };
        let is_plant = WordNet::get().is_a(word, PLANT);
        // Another species does not match: a cactus is not a tulip.
        let is_species =
            |noun: &Noun| noun.name != "flower" && WordNet::get().is_a(&noun.name, PLANT);
        let for_plants = |noun: &&Noun| {
            noun.kinds.iter().any(|kind| kind == "plant") && !is_species(noun)
                || noun.uses.iter().any(|spoken| spoken == "put flowers in")
        };
        let mut holding: Vec<&Noun> = self
            .nouns
            .iter()
            .filter(|noun| called_after(noun) || is_plant && for_plants(noun))
            .collect();
        holding.sort_by(|a, b| b.prior.total_cmp(&a.prior));
        holding
    }

    /// Returns whether a word, or its singular, refers to a noun.
    #[must_use]
    pub fn is_known(&self, word: &str) -> bool {
        singulars(word).iter().any(|w| self.by_word.contains_key(w))
    }

    /// Returns the lexicon's spelling of a word that refers to a noun.
    #[must_use]
    pub fn canonical_word(&self, word: &str) -> Option<&str> {
        self.by_word.get_key_value(word).map(|(known, _)| known.as_str())
    }

    /// Returns whether a word is the plural of one that refers to a noun: "chairs", but not
    /// "curtains" where that is an entry of its own.
    #[must_use]
    pub fn is_plural(&self, word: &str) -> bool {
        !self.by_word.contains_key(word) && self.is_known(word)
    }

    /// Returns all words that refer to a noun, in any order.
    pub fn words(&self) -> impl Iterator<Item = &str> {
        self.by_word.keys().map(String::as_str)
    }

    /// Returns the nouns of things that serve one of these uses.
    #[must_use]
    pub fn nouns_for_uses(&self, uses: &[String]) -> Vec<&Noun> {
        self.nouns.iter().filter(|noun| noun.uses.iter().any(|own| uses.contains(own))).collect()
    }

    /// Returns the number of words of the longest entry.
    #[must_use]
    pub fn longest_words(&self) -> usize {
        self.longest_words
    }

    fn read(text: &str) -> Self {
        let nouns: Vec<Noun> = text
            .lines()
            .filter(|line| !line.starts_with('#') && !line.trim().is_empty())
            .filter_map(read_line)
            .collect();
        let mut by_word: HashMap<String, Vec<usize>> = HashMap::new();
        // Names and synonyms first, then kinds, so that the direct meaning comes first.
        for (i, noun) in nouns.iter().enumerate() {
            for word in std::iter::once(&noun.name).chain(&noun.synonyms) {
                by_word.entry(word.clone()).or_default().push(i);
            }
        }
        for (i, noun) in nouns.iter().enumerate() {
            for word in &noun.kinds {
                let meanings = by_word.entry(word.clone()).or_default();
                if !meanings.contains(&i) {
                    meanings.push(i);
                }
            }
        }
        let longest_words = by_word.keys().map(|w| w.split(' ').count()).max().unwrap_or(1);
        Self { nouns, by_word, longest_words }
    }
}

fn read_line(line: &str) -> Option<Noun> {
    let columns: Vec<&str> = line.split('\t').collect();
    let [name, synonyms, kinds, long, short, height, base, support, usual, shape, usually_on, uses] =
        columns[..]
    else {
        return None;
    };
    let words = |list: &str| {
        list.split(',')
            .map(str::trim)
            .filter(|w| !w.is_empty())
            .map(str::to_owned)
            .collect::<Vec<_>>()
    };
    let places = words(support)
        .iter()
        .map(|place| match place.as_str() {
            "floor" => Some(Place::Floor),
            "surface" => Some(Place::Surface),
            "wall" => Some(Place::Wall),
            "legs" => Some(Place::Legs),
            _ => None,
        })
        .collect::<Option<_>>()?;
    Some(Noun {
        name: name.to_owned(),
        synonyms: words(synonyms),
        kinds: words(kinds),
        long: parse_range(long)?,
        short: parse_range(short)?,
        height: parse_range(height)?,
        base: parse_range(base)?,
        places,
        shape: match shape {
            "flat" => Shape::Flat,
            "boxy" => Shape::Boxy,
            "open" => Shape::Open,
            "round" => Shape::Round,
            "bushy" => Shape::Bushy,
            "soft" => Shape::Soft,
            _ => return None,
        },
        usually_on: words(usually_on),
        uses: words(uses),
        prior: match usual {
            "common" => 1.0,
            "usual" => 0.8,
            "rare" => 0.6,
            _ => return None,
        },
    })
}

/// Parses `low-high`. The low end can be negative.
fn parse_range(text: &str) -> Option<Range> {
    let dash = text.char_indices().skip(1).find(|(_, c)| *c == '-')?.0;
    let (low, high) = (text[..dash].parse().ok()?, text[dash + 1..].parse().ok()?);
    (low <= high).then_some(Range { low, high })
}

/// Returns the word itself, followed by its possible singulars.
pub(super) fn singulars(word: &str) -> Vec<String> {
    let mut forms = vec![word.to_owned()];
    if let Some(stem) = word.strip_suffix("ies") {
        forms.push(format!("{stem}y"));
    }
    if let Some(stem) = word.strip_suffix("ves") {
        forms.push(format!("{stem}f"));
    }
    if let Some(stem) = word.strip_suffix("es") {
        forms.push(stem.to_owned());
    }
    if let Some(stem) = word.strip_suffix('s') {
        forms.push(stem.to_owned());
    }
    forms
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashSet;

    #[test]
    fn every_line_of_the_lexicon_can_be_parsed() {
        let lines = include_str!("lexicon.tsv")
            .lines()
            .filter(|l| !l.starts_with('#') && !l.trim().is_empty());
        for line in lines {
            let noun = read_line(line).unwrap_or_else(|| panic!("not an entry: {line}"));
            assert!(noun.long.high >= noun.short.low, "{line}");
        }
    }

    #[test]
    fn usual_places_exist_and_names_and_synonyms_are_unique() {
        let nouns = Lexicon::get().nouns();
        assert!(nouns.len() >= 250, "{}", nouns.len());
        let names: HashSet<&str> = nouns.iter().map(|noun| noun.name.as_str()).collect();
        assert_eq!(names.len(), nouns.len());
        let mut synonyms = HashSet::new();
        for noun in nouns {
            for place in &noun.usually_on {
                assert!(
                    names.contains(place.as_str())
                        || ["floor", "wall", "ceiling"].contains(&place.as_str()),
                    "{}: {place}",
                    noun.name
                );
            }
            for synonym in &noun.synonyms {
                assert!(
                    !names.contains(synonym.as_str()) && synonyms.insert(synonym),
                    "{}: {synonym}",
                    noun.name
                );
            }
        }
    }

    #[test]
    fn synonyms_plurals_and_kinds_resolve_to_nouns() {
        let lexicon = Lexicon::get();
        assert_eq!(lexicon.find("couch").unwrap().name, "sofa");
        assert_eq!(lexicon.find("bookshelves").map(|n| n.name.as_str()), Some("bookcase"));
        assert_eq!(lexicon.find("boxes").unwrap().name, "box");
        let chairs: Vec<_> = lexicon.find_all("chairs").iter().map(|n| n.name.as_str()).collect();
        assert_eq!(chairs[0], "chair");
        assert!(chairs.contains(&"office chair") && chairs.contains(&"armchair"));
        assert!(lexicon.find("quaternion").is_none());
    }
}
