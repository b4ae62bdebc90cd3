//! `uniground openapi`: the HTTP description, as the server serves it.

pub fn run() -> anyhow::Result<()> {
    println!("{}", crate::http::openapi().to_pretty_json()?);
    Ok(())
}
