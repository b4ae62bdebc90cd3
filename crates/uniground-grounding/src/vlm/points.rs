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

    /// Converts x and y as the model wrote them to shares of width and height, `0..=1`. `None` for
    /// a place outside of the picture.
    #[must_use]
    pub fn to_shares(self, at: [f32; 2], (width, height): (u32, u32)) -> Option<[f32; 2]> {
        let whole = match self {
            Self::Thousandths => [1000.0; 2],
            Self::Pixels => [width as f32, height as f32],
        };
        let shares = [at[0] / whole[0], at[1] / whole[1]];
        shares.iter().all(|share| (0.0..=1.0).contains(share)).then_some(shares)
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
    }
}
