//! The kinds of spatial relations.

/// A relation between an object and its anchors. `uniground_grounding::relations` has the geometry
/// of each kind.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RelationKind {
    /// "next to", "by": a small gap between the surfaces, against the objects' sizes.
    Near,
    /// The opposite of near.
    Far,
    /// Nearer than the other candidates; `rank` counts from the nearest.
    Closest,
    /// Farther than the other candidates; `rank` counts from the farthest.
    Farthest,
    /// To the left in the directions of the question, and not far.
    LeftOf,
    /// To the right in the directions of the question, and not far.
    RightOf,
    /// In front in the directions of the question; an anchor at a wall has a front of its own, away
    /// from the wall.
    InFrontOf,
    /// The opposite side of in front.
    Behind,
    /// Higher than the anchor and over its footprint, touching or not.
    Above,
    /// Lower than the anchor and under its footprint, touching or not.
    Below,
    /// Resting on the anchor or on a board inside it, or flat against an upright plane ("the
    /// picture on the wall").
    On,
    /// The inverse of on: the anchor rests on it.
    Carrying,
    /// By the share of its volume within the anchor; resting on the anchor counts a little less.
    Inside,
    /// Near the middle of the line between two anchors, on the ground plan.
    Between,
    /// Beside the anchor at its height: chairs around a table.
    Around,
    /// Apart from the anchor and in line with one of its axes.
    Opposite,
    /// Turned towards the anchor, with any of its four sides: a box has no front.
    Facing,
    /// Touching the anchor from the side.
    Leaning,
    /// Close to any wall or side of the room; no anchor.
    AgainstWall,
    /// Close to two sides of the room that meet; no anchor.
    InCorner,
    /// Near the middle of the room; no anchor.
    InMiddle,
}

impl RelationKind {
    /// All 21 values, to find one by its [`as_str`](Self::as_str).
    pub const ALL: [Self; 21] = [
        Self::Near,
        Self::Far,
        Self::Closest,
        Self::Farthest,
        Self::LeftOf,
        Self::RightOf,
        Self::InFrontOf,
        Self::Behind,
        Self::Above,
        Self::Below,
        Self::On,
        Self::Carrying,
        Self::Inside,
        Self::Between,
        Self::Around,
        Self::Opposite,
        Self::Facing,
        Self::Leaning,
        Self::AgainstWall,
        Self::InCorner,
        Self::InMiddle,
    ];

    /// Returns its name in data: `left_of`.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Near => "near",
            Self::Far => "far",
            Self::Closest => "closest",
            Self::Farthest => "farthest",
            Self::LeftOf => "left_of",
            Self::RightOf => "right_of",
            Self::InFrontOf => "in_front_of",
            Self::Behind => "behind",
            Self::Above => "above",
            Self::Below => "below",
            Self::On => "on",
            Self::Carrying => "carrying",
            Self::Inside => "inside",
            Self::Between => "between",
            Self::Around => "around",
            Self::Opposite => "opposite",
            Self::Facing => "facing",
            Self::Leaning => "leaning",
            Self::AgainstWall => "against_wall",
            Self::InCorner => "in_corner",
            Self::InMiddle => "in_middle",
        }
    }

    /// Returns whether it compares candidates: "closest".
    #[must_use]
    pub fn is_comparison(self) -> bool {
        matches!(self, Self::Closest | Self::Farthest)
    }

    /// Returns whether it names a side of the anchor.
    #[must_use]
    pub fn is_a_side(self) -> bool {
        matches!(self, Self::LeftOf | Self::RightOf | Self::InFrontOf | Self::Behind)
    }

    /// Returns whether it relates to the room and takes no anchor.
    #[must_use]
    pub fn is_of_the_room(self) -> bool {
        matches!(self, Self::AgainstWall | Self::InCorner | Self::InMiddle)
    }

    /// Returns whether it depends on the viewer, or on what people call "between" and a corner, and
    /// not on boxes alone.
    #[must_use]
    pub fn depends_on_who_looks(self) -> bool {
        matches!(
            self,
            Self::LeftOf
                | Self::RightOf
                | Self::InFrontOf
                | Self::Behind
                | Self::Between
                | Self::Opposite
                | Self::Facing
                | Self::InCorner
                | Self::InMiddle
        )
    }

    /// Returns the relation of the anchor to the object: "there is a lamp on it" says that it
    /// carries a lamp.
    #[must_use]
    pub fn inverse(self) -> Self {
        match self {
            Self::LeftOf => Self::RightOf,
            Self::RightOf => Self::LeftOf,
            Self::InFrontOf => Self::Behind,
            Self::Behind => Self::InFrontOf,
            Self::Above => Self::Below,
            Self::Below => Self::Above,
            Self::On | Self::Inside | Self::Leaning => Self::Carrying,
            Self::Carrying => Self::On,
            other => other,
        }
    }
}
