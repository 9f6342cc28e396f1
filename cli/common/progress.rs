//! Progress bars: on standard error, and only where somebody sees them.

use std::io::IsTerminal;

use anyhow::{Context, Result};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

/// A bar of this length and look (a template of `indicatif`).
pub fn bar(length: u64, template: &str) -> Result<ProgressBar> {
    if !std::io::stderr().is_terminal() {
        return Ok(ProgressBar::with_draw_target(None, ProgressDrawTarget::hidden()));
    }
    let style = ProgressStyle::with_template(template).context("the template of the progress bar")?;
    Ok(ProgressBar::new(length).with_style(style))
}
