//! Questions to a person in a terminal, or to a script at the other end of a pipe: one line each.

use std::io::{self, BufRead};

use anyhow::{Result, anyhow};

use crate::common::output;

/// Says what it wants, and gives the line that was answered, without blanks at its ends.
pub fn ask(question: &str) -> Result<String> {
    output::text(format_args!("{question} "))?;
    let mut line = String::new();
    let read = io::stdin().lock().read_line(&mut line)?;
    if read == 0 {
        output::line("")?;
        return Err(anyhow!("the input has ended before the last answer; nothing was stored"));
    }
    Ok(line.trim().to_owned())
}

/// Asks until the answer is yes or no; Enter is no.
pub fn confirm(question: &str) -> Result<bool> {
    loop {
        match ask(&format!("{question} [y/N]"))?.to_lowercase().as_str() {
            "y" | "yes" => return Ok(true),
            "" | "n" | "no" => return Ok(false),
            other => output::line(format_args!("got `{other}`, expected y or n"))?,
        }
    }
}

/// Asks until the answer is a number within limits; Enter takes `usual`.
pub fn number(question: &str, usual: f64, (min, max): (f64, f64)) -> Result<f64> {
    loop {
        let answer = ask(question)?;
        if answer.is_empty() {
            return Ok(usual);
        }
        match answer.parse::<f64>() {
            Ok(number) if number >= min && number <= max => return Ok(number),
            _ => output::line(format_args!("got `{answer}`, allowed is a number from {min} to {max}"))?,
        }
    }
}
