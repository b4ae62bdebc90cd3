//! The range of color channels. Files do not always keep to the one that their types suggest: floats
//! up to 255, 16-bit numbers up to 255 or 4,095 and signed numbers all occur. So the range is told
//! from the values.

use uniground_types::findings::{Finding, FindingSubject};

/// The range of color channels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(in crate::clouds) enum ColorRange {
    /// 0 to 1.
    Unit,
    /// 0 to 255.
    Bytes,
    /// 0 to 1,023.
    TenBits,
    /// 0 to 4,095.
    TwelveBits,
    /// 0 to 16,383.
    FourteenBits,
    /// 0 to 65,535.
    Words,
    /// -1 to 1.
    SignedUnit,
    /// Bytes that were written as signed numbers: -128 to 127.
    SignedBytes,
}

/// The ranges without negative numbers, ascending.
const UNSIGNED: [ColorRange; 6] = [
    ColorRange::Unit,
    ColorRange::Bytes,
    ColorRange::TenBits,
    ColorRange::TwelveBits,
    ColorRange::FourteenBits,
    ColorRange::Words,
];

impl ColorRange {
    /// Returns the ends of the range.
    fn ends(self) -> (f64, f64) {
        match self {
            Self::Unit => (0.0, 1.0),
            Self::Bytes => (0.0, 255.0),
            Self::TenBits => (0.0, 1023.0),
            Self::TwelveBits => (0.0, 4095.0),
            Self::FourteenBits => (0.0, 16_383.0),
            Self::Words => (0.0, 65_535.0),
            Self::SignedUnit => (-1.0, 1.0),
            Self::SignedBytes => (-128.0, 127.0),
        }
    }

    /// Returns the narrowest range without negative numbers that holds a channel. Values slightly
    /// above the end are rounding errors.
    pub fn needed_for(channel: f64) -> Self {
        match channel {
            v if v < 2.0 => Self::Unit,
            v if v < 256.0 => Self::Bytes,
            v if v < 1024.0 => Self::TenBits,
            v if v < 4096.0 => Self::TwelveBits,
            v if v < 16_384.0 => Self::FourteenBits,
            _ => Self::Words,
        }
    }

    /// Returns the level of a channel, 0 to 255. Values outside of the range saturate.
    pub fn to_level(self, channel: f64) -> u8 {
        match self {
            Self::SignedUnit => ((channel + 1.0) * 127.5).round() as u8,
            Self::SignedBytes if channel < 0.0 => (channel + 256.0).round() as u8,
            Self::SignedBytes => channel.round() as u8,
            _ => (channel * (255.0 / self.ends().1)).round() as u8,
        }
    }

    /// Returns the level in this range of a level in a narrower one without negative numbers.
    pub fn widen(self, level: u8, narrower: Self) -> u8 {
        (f64::from(level) * (narrower.ends().1 / self.ends().1)).round() as u8
    }
}

/// Returns the channel (0 to 2) that a property or column with this name holds, by the names that
/// usual programs write.
pub(in crate::clouds) fn channel_of_name(name: &str) -> Option<usize> {
    let name = name.to_ascii_lowercase();
    let short = name.strip_prefix("diffuse_").or(name.strip_prefix("color_")).unwrap_or(&name);
    [["r", "red"], ["g", "green"], ["b", "blue"]].iter().position(|names| names.contains(&short))
}

/// Maximum share of points beyond a range that are errors of the file and not evidence for a wider
/// one. A range that is [`FAR_WIDER`] times wider needs more: a picture is not that dark.
const FEW: f64 = 0.001;
const FEW_FAR: f64 = 0.1;
const FAR_WIDER: f64 = 64.0;
/// Minimum share of points with a negative channel in files whose range has negative numbers.
const OFTEN_NEGATIVE: f64 = 0.05;
/// Channels closer to zero than this are rounding errors.
const NEGATIVE: f64 = -0.002;

/// Counts of points by the range that their color channels need. Black points tell nothing and are
/// not counted.
#[derive(Debug, Clone, Default)]
pub(in crate::clouds) struct ChannelTally {
    needed: [usize; UNSIGNED.len()],
    /// Number of points with a negative channel.
    negative: usize,
    lowest: f64,
    has_fractions: bool,
}

impl ChannelTally {
    /// Counts a point. Returns the narrowest range without negative numbers that holds its channels.
    #[inline]
    pub fn add(&mut self, channels: [f64; 3]) -> ColorRange {
        // An infinite channel tells nothing about the others.
        let finite = || channels.into_iter().filter(|v| v.is_finite());
        let (lowest, largest) = finite().fold((0.0, 0.0), |(l, h), v| (v.min(l), v.max(h)));
        let needed = ColorRange::needed_for(largest);
        self.needed[needed as usize] += usize::from(largest > 0.0 || lowest < 0.0);
        if lowest < NEGATIVE {
            self.negative += 1;
            self.lowest = self.lowest.min(lowest);
            self.has_fractions |= finite().any(|v| v.fract() != 0.0);
        }
        needed
    }

    /// Returns the range that all but a few points keep to, and the number of those beyond it.
    /// `declared` is the narrowest range that the file's types suggest.
    pub fn range(&self, declared: ColorRange) -> (ColorRange, usize) {
        let all = self.needed.iter().sum::<usize>() as f64;
        // No picture is that dark: 0 to 1 was written as bytes.
        let in_unit = self.needed[ColorRange::Unit as usize] as f64;
        let declared = if all > 0.0 && in_unit == all { ColorRange::Unit } else { declared };
        let (mut range, mut beyond) = (ColorRange::Words, 0);
        for candidate in UNSIGNED.into_iter().filter(|range| *range >= declared) {
            let wider = || UNSIGNED.into_iter().filter(move |other| *other > candidate);
            let is_far = |other: &ColorRange| other.ends().1 >= FAR_WIDER * candidate.ends().1;
            let points = |others: &mut dyn Iterator<Item = ColorRange>| {
                others.map(|other| self.needed[other as usize]).sum::<usize>()
            };
            let total = points(&mut wider());
            let near = points(&mut wider().filter(|other| !is_far(other)));
            if near as f64 <= FEW * all && total as f64 <= FEW_FAR * all {
                (range, beyond) = (candidate, total);
                break;
            }
        }
        if self.negative as f64 > OFTEN_NEGATIVE * all {
            let beyond_half = |half: f64| self.lowest < -half;
            match range {
                ColorRange::Unit if !beyond_half(1.01) => range = ColorRange::SignedUnit,
                ColorRange::Bytes if !beyond_half(128.0) && !self.has_fractions => {
                    range = ColorRange::SignedBytes;
                }
                _ => {}
            }
        }
        (range, beyond)
    }

    /// Describes what was assumed about the range that [`range`](Self::range) returns.
    pub fn findings(&self, declared: ColorRange) -> Vec<Finding> {
        let (range, beyond) = self.range(declared);
        let mut findings = Vec::new();
        if range != declared {
            let (low, high) = range.ends();
            let text =
                format!("color channels are read as {low} to {high}, told from their values");
            let is_usual =
                [ColorRange::Unit, ColorRange::Bytes, ColorRange::Words].contains(&range);
            findings.push(match is_usual {
                true => Finding::assumed(FindingSubject::Color, text).without_warning(),
                false => Finding::assumed(
                    FindingSubject::Color,
                    format!("{text}: write them as 0 to 255 if the colors are wrong"),
                ),
            });
        }
        if beyond > 0 {
            let text =
                format!("the colors of {beyond} points exceed the range of the others: cut off");
            findings.push(Finding::assumed(FindingSubject::Color, text).counting(beyond));
        }
        let is_signed = [ColorRange::SignedUnit, ColorRange::SignedBytes].contains(&range);
        if self.negative > 0 && !is_signed {
            let negative = self.negative;
            let text = format!("the colors of {negative} points are negative: read as 0");
            findings.push(Finding::unusual(FindingSubject::Color, text).counting(negative));
        }
        findings
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the range of gray points of these brightnesses, and the number beyond it.
    fn range_of(
        values: impl IntoIterator<Item = f64>,
        declared: ColorRange,
    ) -> (ColorRange, usize) {
        let mut tally = ChannelTally::default();
        values.into_iter().for_each(|v| {
            tally.add([v; 3]);
        });
        tally.range(declared)
    }

    /// Returns brightnesses spread evenly from `low` to `high`.
    fn spread(low: f64, high: f64) -> impl Iterator<Item = f64> {
        (0..1000).map(move |i| low + (high - low) * f64::from(i) / 999.0)
    }

    #[test]
    fn range_is_told_from_the_values() {
        use ColorRange::{Bytes, FourteenBits, SignedUnit, TenBits, TwelveBits, Unit, Words};
        for (low, high, declared, expected) in [
            (0.0, 1.0, Unit, Unit),
            (0.0, 1.0, Bytes, Unit),
            (0.0, 255.0, Unit, Bytes),
            (0.0, 1023.0, Bytes, TenBits),
            (0.0, 4095.0, Bytes, TwelveBits),
            (0.0, 16_383.0, Bytes, FourteenBits),
            (0.0, 65_535.0, Bytes, Words),
            (-1.0, 1.0, Unit, SignedUnit),
            (-0.001, 1.0, Unit, Unit),
        ] {
            assert_eq!(range_of(spread(low, high), declared), (expected, 0), "{low} to {high}");
        }
        let signed = (0..1000).map(|i| f64::from(i % 256 - 128));
        assert_eq!(range_of(signed, Bytes).0, ColorRange::SignedBytes);
    }

    #[test]
    fn wrong_values_do_not_darken_the_others() {
        let with = |wrong: usize, value: f64| {
            range_of(spread(1.0, 255.0).chain(std::iter::repeat_n(value, wrong)), ColorRange::Bytes)
        };
        assert_eq!(with(50, 65_535.0), (ColorRange::Bytes, 50));
        assert_eq!(with(1, 300.0), (ColorRange::Bytes, 1));
        // A twentieth of the points slightly beyond is a wider range.
        assert_eq!(with(50, 900.0).0, ColorRange::TenBits);
        assert_eq!(with(500, 65_535.0).0, ColorRange::Words);
    }

    #[test]
    fn ranges_map_their_ends_to_black_and_white() {
        for range in UNSIGNED.into_iter().chain([ColorRange::SignedUnit]) {
            let (low, high) = range.ends();
            assert_eq!((range.to_level(low), range.to_level(high)), (0, 255), "{range:?}");
        }
        assert_eq!(
            [-128.0, -1.0, 127.0].map(|v| ColorRange::SignedBytes.to_level(v)),
            [128, 255, 127]
        );
    }
}
