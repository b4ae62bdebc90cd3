//! Prints results as JSON, and warnings in red.

use clap::builder::styling::{AnsiColor, Style};
use serde::Serialize;
use std::io::{self, IsTerminal, Write};

/// Prints a value as JSON on standard output.
///
/// # Errors
/// Returns an error if standard output cannot be written.
pub fn print_json(value: &impl Serialize) -> anyhow::Result<()> {
    Ok(writeln!(io::stdout(), "{}", serde_json::to_string_pretty(value)?)?)
}

/// Formats a warning in red if the terminal supports color.
pub fn in_red_on_terminal(words: &str) -> String {
    let is_set = |name| std::env::var_os(name).is_some_and(|value| !value.is_empty());
    let is_dumb = std::env::var_os("TERM").is_some_and(|term| term == "dumb");
    match io::stdout().is_terminal() && !is_set("NO_COLOR") && !is_dumb {
        true => in_red(words),
        false => words.to_owned(),
    }
}

fn in_red(words: &str) -> String {
    let style = Style::new().bold().fg_color(Some(AnsiColor::Red.into()));
    format!("{style}{words}{style:#}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn red_text_resets_its_style() {
        assert_eq!(in_red("no model"), "\u{1b}[1m\u{1b}[31mno model\u{1b}[0m");
    }
}
