//! `uniground openapi`: prints the OpenAPI description that the server serves.

use std::io::{self, Write};

pub fn run() -> anyhow::Result<()> {
    writeln!(io::stdout(), "{}", crate::http::openapi().to_pretty_json()?)?;
    Ok(())
}
