//! Questions in plain words, and what they come to over a few things in a room.
#![no_main]

use libfuzzer_sys::fuzz_target;
use uniground_core::language::parse;

fuzz_target!(|text: &str| {
    // The service takes no longer ones.
    let text: String = text.chars().take(2000).collect();
    let _ = parse(&text);
});
