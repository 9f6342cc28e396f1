//! How the camera of a `lane-lines` node looks at the floor, from a straight lane.

use std::path::Path;

use anyhow::{Result, anyhow, bail};
use carril_operators::lane_lines::LaneLinesConfig;
use carril_operators::lane_lines::survey::{CameraFindings, CameraSurvey, PoseVerdict, Spread};
use carril_runtime::Registry;
use carril_runtime::graph::calibration::Subject;
use serde_json::{Map, Value, json};

use super::{LaneArgs, look};
use crate::commands::calibrate::keep::{Found, keep};
use crate::commands::calibrate::target::Target;
use crate::common::graph_file::Shown;
use crate::common::output;

pub(super) fn run(args: &LaneArgs, target: &Target, registry: &Registry) -> Result<()> {
    let config: LaneLinesConfig = target.config()?;
    let node = &target.node;
    let mut survey = CameraSurvey::new(&config).map_err(|why| anyhow!("node `{node}`: {why}"))?;
    let source = look(args, target, |image| survey.add(image))?;
    let findings = survey.findings();
    if !args.keep.json {
        output::text(told(node, &config, &source, &findings))?;
    }
    let (PoseVerdict::Found, Some(height), Some(pitch)) = (findings.verdict, findings.height_m, findings.pitch_deg)
    else {
        if args.keep.json {
            output::json(&figures_json(node, &source, &config, &findings, None))?;
            return Err(Shown.into());
        }
        bail!("{}", refused(node, &config, &findings));
    };
    let values = Map::from_iter([
        ("camera.height_m".to_owned(), rounded(height.value, 1e3)),
        ("camera.pitch_deg".to_owned(), rounded(pitch.value, 1e2)),
    ]);
    if !args.keep.json {
        let (height, pitch) = (&values["camera.height_m"], &values["camera.pitch_deg"]);
        output::line(format_args!("\nproposal: {node}.camera.height_m {height}, {node}.camera.pitch_deg {pitch}"))?;
    }
    let found = Found { subject: Subject::Lane, values, figures: figures(&source, &config, &findings) };
    let saved = keep(&found, target, &args.keep, registry)?;
    if args.keep.json {
        output::json(&figures_json(node, &source, &config, &findings, saved.as_deref()))?;
    }
    Ok(())
}

fn told(node: &str, config: &LaneLinesConfig, source: &str, findings: &CameraFindings) -> String {
    let frames = output::counted(findings.frames as u64, "frame");
    let mut text = format!(
        "{node}: {frames} of `{source}`: {} with both lines of a straight lane, taken to be {} m apart\n\n",
        findings.straight, config.lane_width_m,
    );
    let cells = |name: &str, unit: &str, in_force: f64, found: Option<Spread>, digits: usize| {
        let found = found?;
        let number = |value: f64| format!("{value:.digits$} {unit}");
        Some(vec![name.to_owned(), number(in_force), number(found.value), format!("+-{}", number(found.spread))])
    };
    let rows = [
        cells("height_m", "m", config.camera.height_m, findings.height_m, 3),
        cells("pitch_deg", "degrees", config.camera.pitch_deg, findings.pitch_deg, 2),
    ];
    let rows: Vec<Vec<String>> = rows.into_iter().flatten().collect();
    if !rows.is_empty() {
        text += &output::table(&["CAMERA", ">IN FORCE", ">FOUND", ">SPREAD"], &rows);
    }
    text
}

/// Why there is no proposal, and what helps.
fn refused(node: &str, config: &LaneLinesConfig, findings: &CameraFindings) -> String {
    let CameraFindings { frames, straight, bent, .. } = findings;
    match findings.verdict {
        PoseVerdict::NotStraight => format!(
            "in {bent} of {frames} frames the lane bends, and only a straight one tells how the camera looks at it\n\
             hint: put the car into a straight of at least {} m (`far_m`)",
            config.far_m
        ),
        PoseVerdict::Scattered => "the frames do not agree on where the camera is\n\
             hint: does the camera shake, or is something else in view that looks like a line? Let the car stand"
            .to_owned(),
        PoseVerdict::NoLane | PoseVerdict::Found => format!(
            "both lines of a straight lane were seen in {straight} of {frames} frames only\n\
             hint: put the car into the middle of a straight lane, look at `carril echo {node}/debug --save debug.png`, and see that \
             `marking`, `line_width_m` and `lane_width_m` are those of the track"
        ),
    }
}

/// So many decimals as the measurement deserves.
fn rounded(value: f64, scale: f64) -> Value {
    ((value * scale).round() / scale).into()
}

/// What goes into the record.
fn figures(source: &str, config: &LaneLinesConfig, findings: &CameraFindings) -> Map<String, Value> {
    let spread = |of: Option<Spread>, scale: f64| of.map_or(Value::Null, |of| rounded(of.spread, scale));
    Map::from_iter([
        ("from".to_owned(), source.into()),
        ("frames".to_owned(), findings.frames.into()),
        ("straight".to_owned(), findings.straight.into()),
        ("lane_width_m".to_owned(), config.lane_width_m.into()),
        ("horizontal_fov_deg".to_owned(), config.camera.horizontal_fov_deg.into()),
        ("height_spread_m".to_owned(), spread(findings.height_m, 1e4)),
        ("pitch_spread_deg".to_owned(), spread(findings.pitch_deg, 1e3)),
    ])
}

fn figures_json(
    node: &str,
    source: &str,
    config: &LaneLinesConfig,
    findings: &CameraFindings,
    saved: Option<&Path>,
) -> Value {
    json!({ "node": node, "from": source, "in_force": config.camera, "findings": findings, "saved": saved })
}
