//! Replies of models, in whatever shape: six fields, names, nothing.
#![no_main]

use libfuzzer_sys::fuzz_target;
use uniground_core::grounding::vlm::{naming, reply};

fuzz_target!(|text: &str| {
    let _ = reply::read(text);
    let _ = reply::only_id(text, |id| id < 10);
    let names = naming::read(text, &[1, 2, 3]);
    assert!(names.keys().all(|id| (1..=3).contains(id)), "names of strangers");
});
