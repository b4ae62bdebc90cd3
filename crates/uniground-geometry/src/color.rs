//! Colors as people name them: sRGB to CIELAB (D65), and the basic color terms of English.

use super::Vector3;
use serde::{Deserialize, Serialize};
use std::sync::LazyLock;

/// CIELAB: lightness 0..=100, then green-red and blue-yellow.
pub type Lab = Vector3<f32>;

/// Converts 8-bit sRGB to CIELAB under D65.
#[must_use]
pub fn srgb_to_lab(rgb: [u8; 3]) -> Lab {
    let [r, g, b] = rgb.map(|channel| LINEAR[usize::from(channel)]);
    // sRGB primaries to XYZ, divided by the D65 white point.
    let x = (0.412_456 * r + 0.357_576 * g + 0.180_438 * b) / 0.950_47;
    let y = 0.212_673 * r + 0.715_152 * g + 0.072_175 * b;
    let z = (0.019_334 * r + 0.119_192 * g + 0.950_304 * b) / 1.088_83;
    let [fx, fy, fz] = [x, y, z].map(lab_curve);
    Lab::new(116.0 * fy - 16.0, 500.0 * (fx - fy), 200.0 * (fy - fz))
}

static LINEAR: LazyLock<[f32; 256]> = LazyLock::new(|| {
    std::array::from_fn(|i| {
        let c = i as f32 / 255.0;
        if c <= 0.040_45 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }
    })
});

/// Applies CIELAB's compressive curve. Uses a table, because a scan has millions of pixels and a
/// cube root is slow.
fn lab_curve(t: f32) -> f32 {
    const STEPS: usize = 4096;
    static TABLE: LazyLock<Vec<f32>> = LazyLock::new(|| {
        (0..=STEPS + 1)
            .map(|i| {
                let t = i as f32 / STEPS as f32;
                if t > 0.008_856 { t.cbrt() } else { 7.787 * t + 16.0 / 116.0 }
            })
            .collect()
    });
    let at = t.clamp(0.0, 1.0) * STEPS as f32;
    let i = at as usize;
    TABLE[i] + (TABLE[i + 1] - TABLE[i]) * (at - i as f32)
}

/// The eleven basic color terms of English (Berlin and Kay), plus beige, which furniture needs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ColorName {
    /// CIELAB lightness below 20 with chroma below 12, or below 28 with chroma below 9.
    Black,
    /// Lightness from 72, chroma below 9.
    White,
    /// Gray. Lightness 28 to 72, chroma below 9; also a dull yellow or a faint blue.
    Grey,
    /// Hue 345° to 46°, except for pale and dull shades.
    Red,
    /// Hue 46° to 72°, chroma from 30; dark ones from 55.
    Orange,
    /// Hue 72° to 105°, chroma from 36, lightness from 45.
    Yellow,
    /// Hue 105° to 190°.
    Green,
    /// Hue 190° to 308°, chroma from 11.
    Blue,
    /// Hue 308° to 345°; from 330° only up to a lightness of 55.
    Purple,
    /// Pale reds, and colors lighter than purple at hues from 330°.
    Pink,
    /// Dark or dull reds, oranges and yellows.
    Brown,
    /// Pale and dull reds, oranges and yellows.
    Beige,
}

impl ColorName {
    /// In order of declaration, which is the order of [`ColorHistogram`].
    pub const ALL: [Self; 12] = [
        Self::Black,
        Self::White,
        Self::Grey,
        Self::Red,
        Self::Orange,
        Self::Yellow,
        Self::Green,
        Self::Blue,
        Self::Purple,
        Self::Pink,
        Self::Brown,
        Self::Beige,
    ];

    /// Returns the English word, lower case.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Black => "black",
            Self::White => "white",
            Self::Grey => "grey",
            Self::Red => "red",
            Self::Orange => "orange",
            Self::Yellow => "yellow",
            Self::Green => "green",
            Self::Blue => "blue",
            Self::Purple => "purple",
            Self::Pink => "pink",
            Self::Brown => "brown",
            Self::Beige => "beige",
        }
    }

    /// Returns the name of a CIELAB color: by chroma first (gray axis), then hue, then lightness.
    ///
    /// Thresholds follow the usual centroids of the basic terms: browns are dark oranges, beiges
    /// pale ones, pinks pale reds.
    #[must_use]
    pub fn from_lab(lab: &Lab) -> Self {
        let lightness = lab.x;
        let chroma = lab.y.hypot(lab.z);
        let hue_deg = lab.z.atan2(lab.y).to_degrees().rem_euclid(360.0);
        // Dark colors look black up to a higher chroma; bright ones need more chroma to look
        // colored.
        if lightness < 20.0 && chroma < 12.0 {
            return Self::Black;
        }
        if chroma < 9.0 {
            return match lightness {
                l if l < 28.0 => Self::Black,
                l if l < 72.0 => Self::Grey,
                _ => Self::White,
            };
        }
        match hue_deg {
            h if !(20.0..345.0).contains(&h) => {
                if lightness > 65.0 {
                    Self::Pink
                } else {
                    Self::Red
                }
            }
            h if h < 46.0 => match (lightness, chroma) {
                (l, _) if l < 30.0 && chroma < 40.0 => Self::Brown,
                (_, c) if c < 18.0 => {
                    if lightness > 65.0 {
                        Self::Beige
                    } else {
                        Self::Brown
                    }
                }
                (l, _) if l > 70.0 => Self::Pink,
                _ => Self::Red,
            },
            h if h < 72.0 => match (lightness, chroma) {
                (l, c) if c < 30.0 => {
                    if l > 62.0 {
                        Self::Beige
                    } else {
                        Self::Brown
                    }
                }
                (l, c) if l < 56.0 && c < 55.0 => Self::Brown,
                _ => Self::Orange,
            },
            h if h < 105.0 => match (lightness, chroma) {
                (l, c) if c < 16.0 => match l {
                    l if l > 62.0 => Self::Beige,
                    l if l > 35.0 => Self::Grey,
                    _ => Self::Brown,
                },
                (l, c) if c < 36.0 => {
                    if l > 60.0 {
                        Self::Beige
                    } else {
                        Self::Brown
                    }
                }
                (l, _) if l < 45.0 => Self::Brown,
                _ => Self::Yellow,
            },
            h if h < 190.0 => Self::Green,
            h if h < 308.0 => {
                if chroma < 11.0 {
                    Self::Grey
                } else {
                    Self::Blue
                }
            }
            h if h < 330.0 => Self::Purple,
            _ => {
                if lightness > 55.0 {
                    Self::Pink
                } else {
                    Self::Purple
                }
            }
        }
    }

    /// Returns how well this name describes `other`, in `0..=1`. People disagree at the borders
    /// between colors.
    #[must_use]
    pub fn similarity(self, other: Self) -> f32 {
        use ColorName::{
            Beige, Black, Blue, Brown, Grey, Orange, Pink, Purple, Red, White, Yellow,
        };
        if self == other {
            return 1.0;
        }
        let pair = if self < other { (self, other) } else { (other, self) };
        match pair {
            (Grey | Brown, Beige)
            | (White, Beige | Grey)
            | (Black, Grey)
            | (Orange, Brown)
            | (Red, Orange) => 0.5,
            (Red, Pink | Brown)
            | (Blue, Purple)
            | (Purple, Pink)
            | (Orange, Yellow)
            | (Black, Brown) => 0.4,
            (Yellow | Pink, Beige) | (Grey, Blue) => 0.25,
            _ => 0.0,
        }
    }
}

/// Share of each color name among an instance's points, in the order of [`ColorName::ALL`]; sums
/// to 1.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct ColorHistogram(pub [f32; 12]);

impl ColorHistogram {
    /// Counts 8-bit sRGB colors by name. All shares are 0 when there are no colors.
    pub fn from_colors(colors: impl IntoIterator<Item = [u8; 3]>) -> Self {
        let mut counts = [0_u32; 12];
        for rgb in colors {
            counts[ColorName::from_lab(&srgb_to_lab(rgb)) as usize] += 1;
        }
        let total = counts.iter().sum::<u32>().max(1) as f32;
        Self(counts.map(|n| n as f32 / total))
    }

    /// Creates a histogram with equal shares of these names.
    #[must_use]
    pub fn uniform(names: &[ColorName]) -> Self {
        let mut shares = [0.0; 12];
        names.iter().for_each(|&name| shares[name as usize] += 1.0 / names.len() as f32);
        Self(shares)
    }

    /// Returns the share of the points with exactly this name, `0..=1`. Similar names do not count.
    #[must_use]
    pub fn share(&self, name: ColorName) -> f32 {
        self.0[name as usize]
    }

    /// Returns the names by descending share, without those under 10 %.
    #[must_use]
    pub fn dominant(&self) -> Vec<(ColorName, f32)> {
        let mut named: Vec<_> = ColorName::ALL
            .into_iter()
            .map(|n| (n, self.share(n)))
            .filter(|(_, s)| *s >= 0.1)
            .collect();
        named.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
        named
    }

    /// Returns how well the word `name` describes these points, in `0..=1`. The full score needs 60
    /// % of the points with this name. Similar names count less: a brown desk matches "orange", but
    /// an orange desk matches it better.
    #[must_use]
    pub fn name_fit(&self, name: ColorName) -> f32 {
        let kin: f32 = ColorName::ALL
            .into_iter()
            .filter(|other| *other != name)
            .map(|other| self.share(other) * name.similarity(other))
            .sum();
        (self.share(name) / 0.6 + kin).min(1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lab_matches_published_values() {
        for (rgb, expected) in [
            ([255, 255, 255], [100.0, 0.0, 0.0]),
            ([255, 0, 0], [53.24, 80.09, 67.20]),
            ([0, 0, 255], [32.30, 79.19, -107.86]),
            ([128, 128, 128], [53.59, 0.0, 0.0]),
        ] {
            let lab = srgb_to_lab(rgb);
            assert!((lab - Lab::from(expected)).norm() < 0.3, "{rgb:?} gave {lab:?}");
        }
    }

    #[test]
    fn common_colors_get_the_expected_names() {
        use ColorName::*;
        for (rgb, name) in [
            ([10, 10, 10], Black),
            ([240, 240, 240], White),
            ([128, 128, 128], Grey),
            ([200, 30, 30], Red),
            ([230, 120, 20], Orange),
            ([230, 210, 40], Yellow),
            ([40, 140, 60], Green),
            ([40, 70, 180], Blue),
            ([120, 40, 140], Purple),
            ([240, 150, 180], Pink),
            ([110, 70, 40], Brown),
            ([215, 195, 165], Beige),
            ([60, 40, 30], Brown),
            ([90, 120, 200], Blue),
            ([160, 110, 60], Brown),
        ] {
            assert_eq!(
                ColorName::from_lab(&srgb_to_lab(rgb)),
                name,
                "{rgb:?} {:?}",
                srgb_to_lab(rgb)
            );
        }
    }

    #[test]
    fn similarity_is_symmetric() {
        for a in ColorName::ALL {
            for b in ColorName::ALL {
                assert_eq!(a.similarity(b), b.similarity(a));
            }
        }
    }
}
