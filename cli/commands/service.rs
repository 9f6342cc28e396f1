//! `carril service`: a graph that starts with the machine, as a unit of systemd.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode, ExitStatus};

use anyhow::{Context, Result, bail, ensure};
use carril_dashboard::access::CONFIG_DIR_VARIABLE;
use carril_messages::key::check_name;
use carril_runtime::Registry;
use carril_runtime::client::SERVICES_RUN_DIR;
use carril_runtime::control_plane::RUN_DIR_VARIABLE;
use carril_runtime::graph::Graph;
use clap::{Args, Subcommand};

use crate::common::graph_file::{self, GraphArgs, OverrideArgs};
use crate::common::output;
use crate::common::way::{CONNECT_VARIABLE, endpoint};

/// Examples of `carril service`.
pub const HELP: &str = "The service runs as an ordinary user, starts when the machine does, and again when it fails. Ending it stops the car first.
`journalctl -u NAME` shows what it says; `carril top` and all other commands work as with a graph that was started by hand.

Examples:
  carril service install dataflows/hardware.yaml --print     only show the unit
  sudo carril service install dataflows/hardware.yaml
  sudo carril service install two-machines.yaml --machine laptop --connect car.local
  carril service status
  sudo carril service uninstall carril-car1";

/// Where the units of this machine's owner are.
const UNITS: &str = "/etc/systemd/system";
/// There while systemd runs: `sd_booted(3)`.
const BOOTED: &str = "/run/systemd/system";
/// All services of carril begin with this.
const PREFIX: &str = "carril-";

/// Arguments of `carril service`.
#[derive(Args)]
pub struct ServiceArgs {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand)]
enum What {
    /// Start a graph whenever this machine starts, and now
    Install(InstallArgs),
    /// Stop a service and remove it
    Uninstall(NameArgs),
    /// Show how a service does
    Status(NameArgs),
}

#[derive(Args)]
struct InstallArgs {
    /// The graph file
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Whose rights it has [default: who calls sudo, or you]
    #[arg(long, value_name = "NAME")]
    user: Option<String>,
    /// Name of the service behind `carril-` [default: the robot, and the machine if there is one]
    #[arg(long, value_name = "NAME")]
    name: Option<String>,
    /// Run the nodes that the graph places on this machine, and join the car with them
    #[arg(long, value_name = "NAME")]
    machine: Option<String>,
    /// With --machine: where the car is
    #[arg(long, value_name = "HOST[:PORT]", requires = "machine")]
    connect: Option<String>,
    /// Only show the unit
    #[arg(long)]
    print: bool,
}

#[derive(Args)]
struct NameArgs {
    /// The service, `carril-car1` [default: the only one of this machine]
    #[arg(value_name = "NAME")]
    name: Option<String>,
}

/// Runs it.
pub fn run(args: &ServiceArgs, registry: &Registry) -> Result<ExitCode> {
    match &args.what {
        What::Install(args) => install(args, registry)?,
        What::Uninstall(args) => uninstall(args)?,
        What::Status(args) => return status(args),
    }
    Ok(ExitCode::SUCCESS)
}

/// What a unit says.
struct Unit {
    robot: String,
    user: String,
    program: PathBuf,
    graph: PathBuf,
    machine: Option<String>,
    connect: Option<String>,
    config_dir: Option<PathBuf>,
}

fn install(args: &InstallArgs, registry: &Registry) -> Result<()> {
    let overrides = OverrideArgs { overrides: Vec::new() };
    let graph_args = GraphArgs { file: args.file.clone(), overrides };
    // What does not run by hand does not run as a service either.
    let graph = graph_file::read_for(&graph_args, args.machine.as_deref(), registry)?;
    let unit = Unit::of(args, &graph)?;
    let own = || args.machine.as_ref().map_or(graph.robot.clone(), |machine| format!("{}-{machine}", graph.robot));
    let name = args.name.clone().unwrap_or_else(own);
    check_name(&name)?;
    if args.print {
        return output::text(unit.text());
    }
    must_be_booted()?;
    let service = format!("{PREFIX}{name}.service");
    let path = Path::new(UNITS).join(&service);
    std::fs::write(&path, unit.text()).with_context(|| needs_root(&path))?;
    systemctl(&["daemon-reload"])?;
    systemctl(&["enable", "--now", &service])?;
    output::line(format_args!(
        "`{service}` runs `{}` as user `{}`, now and whenever this machine starts\n\
         what it says: journalctl -u {PREFIX}{name} -f\n\
         how it does:  carril service status {PREFIX}{name}\n\
         to end it:    sudo carril service uninstall {PREFIX}{name}",
        unit.graph.display(),
        unit.user,
    ))
}

fn must_be_booted() -> Result<()> {
    ensure!(
        Path::new(BOOTED).is_dir(),
        "this machine was not started by systemd (there is no `{BOOTED}`): services cannot be installed here; `--print` shows the unit"
    );
    Ok(())
}

fn needs_root(path: &Path) -> String {
    format!("`{}` cannot be changed; services are root's affair: call it with sudo", path.display())
}

impl Unit {
    fn of(args: &InstallArgs, graph: &Graph) -> Result<Self> {
        if let Some(at) = &args.connect {
            endpoint(at)?;
        }
        Ok(Self {
            robot: graph.robot.clone(),
            user: user(args.user.as_deref())?,
            program: std::env::current_exe().context("where is this program?")?,
            graph: graph.path.canonicalize().with_context(|| format!("`{}`", graph.path.display()))?,
            machine: args.machine.clone(),
            connect: args
                .connect
                .clone()
                .or_else(|| std::env::var(CONNECT_VARIABLE).ok().filter(|_| args.machine.is_some())),
            config_dir: std::env::var_os(CONFIG_DIR_VARIABLE).map(PathBuf::from),
        })
    }

    /// The folder below `/run` that systemd makes for it. Tools look there, too.
    fn run_dir(&self) -> String {
        let machine = self.machine.as_ref().map(|machine| format!("-{machine}")).unwrap_or_default();
        format!("{}{machine}", self.robot)
    }

    fn text(&self) -> String {
        let Self { robot, user, .. } = self;
        let graph = self.graph.display().to_string();
        let folder = self.graph.parent().unwrap_or(Path::new("/")).display().to_string();
        let below = SERVICES_RUN_DIR.trim_start_matches("/run/");
        let run_dir = self.run_dir();
        let mut command = vec![self.program.display().to_string(), "run".into(), graph.clone(), "--quiet".into()];
        for (option, value) in [("--machine", &self.machine), ("--connect", &self.connect)] {
            command.extend(value.iter().flat_map(|value| [option.to_owned(), value.clone()]));
        }
        let command: Vec<String> = command.iter().map(|word| quoted(word)).collect();
        let what = match &self.machine {
            Some(machine) => format!("nodes of robot {robot} on machine {machine}"),
            None => format!("robot {robot}"),
        };
        let mut environment =
            format!("Environment={}\n", quoted(&format!("{RUN_DIR_VARIABLE}={SERVICES_RUN_DIR}/{run_dir}")));
        if let Some(dir) = &self.config_dir {
            let setting = quoted(&format!("{CONFIG_DIR_VARIABLE}={}", dir.display()));
            // Writing to a text cannot fail.
            let _ = writeln!(environment, "Environment={setting}");
        }
        format!(
            "# Written by `carril service install`; `carril service uninstall` removes it.\n\
             [Unit]\n\
             Description=carril: {what} ({})\n\
             Wants=network-online.target\n\
             After=network-online.target\n\
             \n\
             [Service]\n\
             Type=exec\n\
             User={user}\n\
             WorkingDirectory={}\n\
             RuntimeDirectory={below}/{run_dir}\n\
             RuntimeDirectoryMode=0700\n\
             {environment}\
             ExecStart={}\n\
             # As Ctrl-C: the car stops first, then the graph. Its processes end with it.\n\
             KillSignal=SIGINT\n\
             KillMode=mixed\n\
             TimeoutStopSec=15\n\
             Restart=on-failure\n\
             RestartSec=2\n\
             # For `priority` and `lock_memory` in the graph.\n\
             LimitRTPRIO=99\n\
             LimitMEMLOCK=infinity\n\
             \n\
             [Install]\n\
             WantedBy=multi-user.target\n",
            escaped(&graph),
            escaped(&folder),
            command.join(" "),
        )
    }
}

/// Percent signs begin specifiers (systemd.unit(5)).
fn escaped(text: &str) -> String {
    text.replace('%', "%%")
}

/// A word of a command line or a setting (systemd.syntax(7)).
fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "/._-:=@+,[]".contains(c);
    if !word.is_empty() && word.chars().all(plain) {
        return word.to_owned();
    }
    let inside = escaped(word).replace('\\', "\\\\").replace('"', "\\\"").replace('$', "$$");
    format!("\"{inside}\"")
}

/// Not root: a graph needs no more than the devices of its user.
fn user(named: Option<&str>) -> Result<String> {
    let of = nix::unistd::User::from_name;
    if let Some(name) = named {
        return Ok(of(name)?.with_context(|| format!("there is no user `{name}`"))?.name);
    }
    let by_sudo = std::env::var("SUDO_USER").ok().and_then(|name| of(&name).ok()?);
    let own = || nix::unistd::User::from_uid(nix::unistd::getuid()).ok()?;
    let found = by_sudo.or_else(own).context("which user? name it with --user")?;
    ensure!(!found.uid.is_root(), "the graph would run with the rights of root; say whose it shall have: --user NAME");
    Ok(found.name)
}

fn systemctl(args: &[&str]) -> Result<()> {
    let status = call(args)?;
    ensure!(status.success(), "`systemctl {}` failed ({status})", args.join(" "));
    Ok(())
}

fn call(args: &[&str]) -> Result<ExitStatus> {
    Command::new("systemctl").args(args).status().context("systemctl cannot be started")
}

/// The services of carril on this machine, without their ending.
fn installed() -> Vec<String> {
    let entries = std::fs::read_dir(UNITS).into_iter().flatten().flatten();
    let names = entries.filter_map(|entry| entry.file_name().into_string().ok());
    let mut names: Vec<String> = names
        .filter_map(|name| Some(name.strip_suffix(".service")?.to_owned()))
        .filter(|name| name.starts_with(PREFIX))
        .collect();
    names.sort();
    names
}

/// The service that is named, with or without `carril-`; else the only one.
fn chosen(args: &NameArgs) -> Result<String> {
    let installed = installed();
    let list = || if installed.is_empty() { "none".to_owned() } else { installed.join(", ") };
    let Some(name) = &args.name else {
        return match &installed[..] {
            [only] => Ok(only.clone()),
            [] => bail!("no service of carril is installed on this machine; `carril service install FILE` does that"),
            _ => bail!("several services are installed: {}; name one", list()),
        };
    };
    let bare = name.trim_end_matches(".service").trim_start_matches(PREFIX);
    let full = format!("{PREFIX}{bare}");
    ensure!(installed.contains(&full), "there is no service `{full}`; installed are: {}", list());
    Ok(full)
}

fn uninstall(args: &NameArgs) -> Result<()> {
    must_be_booted()?;
    let name = chosen(args)?;
    let path = Path::new(UNITS).join(format!("{name}.service"));
    // First whether we may at all: a service that is stopped and stays installed would be neither.
    std::fs::OpenOptions::new().append(true).open(&path).with_context(|| needs_root(&path))?;
    systemctl(&["disable", "--now", &name])?;
    std::fs::remove_file(&path).with_context(|| needs_root(&path))?;
    systemctl(&["daemon-reload"])?;
    output::line(format_args!("`{name}` is stopped and removed"))
}

fn status(args: &NameArgs) -> Result<ExitCode> {
    must_be_booted()?;
    let name = chosen(args)?;
    let status = call(&["status", "--no-pager", &name])?;
    Ok(if status.success() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_are_quoted_as_systemd_reads_them() {
        assert_eq!(quoted("/home/pi/car/dataflow.yaml"), "/home/pi/car/dataflow.yaml", "ordinary");
        assert_eq!(quoted("/home/a b/50%.yaml"), "\"/home/a b/50%%.yaml\"", "a space and a specifier");
        assert_eq!(quoted("a\"b$c\\"), "\"a\\\"b$$c\\\\\"", "quotes, variables, backslashes");
    }
}
