//! The form in which a model gives places in pictures.

/// How a model writes the x and y of a place in a picture. Families of models are trained on one
/// form and are inaccurate in others.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum PointForm {
    /// Thousandths of the picture's width and height.
    #[default]
    Thousandths,
    /// Pixels of the picture as it was sent.
    Pixels,
}

impl PointForm {
    /// Tells the model how to write x and y. `image` is how the prompt refers to the picture.
    #[must_use]
    pub fn describe(self, image: &str) -> String {
        match self {
            Self::Thousandths => format!(
                "x and y are 0 at the left and upper rim of {image} and 1000 at the right and lower one"
            ),
            Self::Pixels => {
                format!("x and y are pixels of {image}, from its left and upper rim")
            }
        }
    }

    /// Converts the corners of a box in the same way. What is outside of the picture is cut off.
    #[must_use]
    pub fn area_to_shares(
        self,
        [left, top, right, bottom]: [f32; 4],
        size: (u32, u32),
    ) -> Option<[f32; 4]> {
        let whole = self.whole(size);
        let share = |value: f32, axis: usize| (value / whole[axis]).clamp(0.0, 1.0);
        let area = [share(left, 0), share(top, 1), share(right, 0), share(bottom, 1)];
        (area[0] < area[2] && area[1] < area[3]).then_some(area)
    }

    /// Converts x and y as the model wrote them to shares of width and height, `0..=1`. `None` for
    /// a place outside of the picture.
    #[must_use]
    pub fn to_shares(self, at: [f32; 2], size: (u32, u32)) -> Option<[f32; 2]> {
        let whole = self.whole(size);
        let shares = [at[0] / whole[0], at[1] / whole[1]];
        shares.iter().all(|share| (0.0..=1.0).contains(share)).then_some(shares)
    }

    /// Returns x and y of the right and lower rim of a picture.
    fn whole(self, (width, height): (u32, u32)) -> [f32; 2] {
        match self {
            Self::Thousandths => [1000.0; 2],
            Self::Pixels => [width as f32, height as f32],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_shares_in_both_forms() {
        let size = (800, 400);
        for (form, at, shares) in [
            (PointForm::Thousandths, [250.0, 500.0], Some([0.25, 0.5])),
            (PointForm::Thousandths, [1001.0, 20.0], None),
            (PointForm::Pixels, [200.0, 200.0], Some([0.25, 0.5])),
            (PointForm::Pixels, [200.0, 401.0], None),
        ] {
            assert_eq!(form.to_shares(at, size), shares, "{form:?} {at:?}");
        }
        let area = |area| PointForm::Thousandths.area_to_shares(area, size);
        assert_eq!(area([250.0, 500.0, 1100.0, 750.0]), Some([0.25, 0.5, 1.0, 0.75]));
        assert_eq!(area([1200.0, 500.0, 1300.0, 750.0]), None);
        let pixels = PointForm::Pixels.area_to_shares([200.0, 100.0, 400.0, 300.0], size);
        assert_eq!(pixels, Some([0.25, 0.25, 0.5, 0.75]));
    }
}
