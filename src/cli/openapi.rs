//! `uniground openapi`: the HTTP description, as the server serves it.

use std::io::{self, Write};

pub fn run() -> anyhow::Result<()> {
    writeln!(io::stdout(), "{}", crate::http::openapi().to_pretty_json()?)?;
    Ok(())
}
