//! Offers photographs without a request: where no candidate fits, the target may be visible in a
//! picture without being an instance.

use super::prompt_context::PromptContext;
use super::visual_evidence::{Photograph, encoded, shrink};
use super::{Ablation, Options, PromptVersion};
use crate::pipeline::QuestionError;
use crate::scene_source::SceneSource;

/// Number of photographs offered; each costs as much as a candidate's collage.
const OFFERED: usize = 2;
/// Maximum size of the longer side of an offered photograph, pixels.
const MOST_PX: u32 = 768;
/// Photographs are offered if the best candidate fits worse than this. In rooms 1 and 2, where the
/// target is listed, the best candidate is above it nine times in ten.
const FITS: f32 = 0.5;

/// Returns the photographs of a scene that look most like the target, where no candidate fits it
/// and the prompt lets the model answer "not listed". Returns none where no encoder has embedded
/// the frames.
///
/// # Errors
/// The encoder fails.
pub fn select_photographs<S: SceneSource>(
    source: &S,
    context: &PromptContext,
    options: Options,
) -> Result<Vec<Photograph>, S::Error> {
    let may_be_told = options.prompt == PromptVersion::Revised
        && !matches!(options.ablation, Ablation::SimplePrompt | Ablation::RawRender);
    let fits = context.candidates.iter().any(|candidate| candidate.score >= FITS);
    // Without the encoder that embedded the scene, the answer says so already.
    let (Some(frames), Ok(Some((encoder, _)))) = (source.frame_embeddings(), source.embeddings())
    else {
        return Ok(Vec::new());
    };
    if fits || !may_be_told {
        return Ok(Vec::new());
    }
    let words = encoder.embed_name(&context.target.text()).map_err(QuestionError::Encoder)?;
    let Some(vector) = words.vector else { return Ok(Vec::new()) };
    let taken = frames.nearest(&vector, OFFERED).into_iter();
    let taken = taken.filter_map(|frame| Some((frame, source.photograph(frame)?)));
    let offered = taken.zip(1..).map(|((frame, photograph), number)| Photograph {
        frame,
        taken_px: photograph.dimensions(),
        picture: encoded(format!("photograph-{number}"), &shrink(photograph, MOST_PX)),
    });
    Ok(offered.collect())
}
