// The line that is always there: who, how well connected, what the car does, and the buttons that matter in a hurry.
import { accessBadge } from "./access";
import type { Car } from "./car";
import { mayEstop, needsControl, say, type Word } from "./control";
import { h, setAttribute, setText } from "./dom";
import { DASH, degrees, duration, fixed } from "./format";
import { lookOfDrive } from "./flow";
import { eyeAge, firstKey, wheelCommandKey } from "./roles";
import type { Subscriptions } from "./subscriptions";
import { nextTheme, theme } from "./theme";
import type { Command, Decision, Telemetry, Vehicle } from "./values";

/** Older numbers are not shown as if they were new. */
const LIMIT_MS = 1000;

interface Figure { root: HTMLElement; value: HTMLElement }

function figure(label: string, unit: string, title: string, id: string): Figure {
  const value = h("span", { class: "figure-value", id }, DASH);
  return { value, root: h("div", { class: "figure", title }, h("span", { class: "figure-label" }, label), h("span", { class: "figure-line" }, value, unit && h("span", { class: "unit" }, unit))) };
}

export function topbar(car: Car, subscriptions: Subscriptions, showKeys: () => void): { root: HTMLElement; refresh(): void } {
  const keys = () => ({
    command: wheelCommandKey(car.nodes), telemetry: firstKey(car.nodes, "carril/WheelTelemetry"),
    vehicle: firstKey(car.nodes, "carril/VehicleState"), state: firstKey(car.nodes, "carril/DecisionState"),
  });
  subscriptions.add(() => {
    const found = keys();
    const main = [found.command, found.telemetry, found.state, found.telemetry ? null : found.vehicle];
    return main.filter((key): key is string => key !== null).map((key) => ({ key, max_hz: 20 }));
  });

  const robot = h("h1", { class: "robot" }, "carril");
  const graph = h("span", { class: "graph-name" });
  const link = h("span", { class: "link-state" });
  const trip = h("span", { class: "link-trip", title: "There and back between this page and the car" });
  const state = h("span", { class: "state-chip", id: "top-state" }, DASH);
  const speed = figure("Speed", "m/s", "Measured by the wheel encoder, + is forward", "top-speed");
  const steering = figure("Steering", "°", "Road-wheel angle, + is left", "top-steering");
  const age = figure("Eye → wheel", "ms", "Age of the camera's exposure from which the newest command at the wheel derives", "top-age");
  const battery = figure("Battery", "V", "As the microcontroller measures it", "top-battery");
  const look = h("button", { type: "button", class: "icon-button", onclick: () => { nextTheme(); nameTheme(); } });
  const nameTheme = () => {
    setText(look, { system: "◐", light: "☀", dark: "☾" }[theme()]);
    setAttribute(look, "aria-label", `Colours: ${theme()}`);
    setAttribute(look, "title", `Colours: ${theme()}`);
  };
  nameTheme();
  const word = (name: Word, label: string, title: string) => needsControl(car, h("button", { type: "button", class: `word word-${name}`, title, onclick: () => void say(car, name) }, label));
  const estop = h("button", { type: "button", class: "estop", id: "estop", title: "Stop at once and stay stopped until reset (space bar)", onclick: () => void say(car, "estop") }, "E-STOP");
  const words = h("div", { class: "words", role: "group", "aria-label": "Control" }, word("start", "Start", "Drive"), word("stop", "Stop", "Slow down, stop and wait for start"), word("reset", "Reset", "Clear latched stops and faults"), estop);

  const root = h("header", { class: "topbar" },
    h("div", { class: "who" }, h("div", { class: "who-line" }, robot, graph), h("div", { class: "link-line" }, link, trip)),
    h("div", { class: "figures" }, h("div", { class: "figure figure-state", title: "State of the decision node" }, h("span", { class: "figure-label" }, "State"), state), speed.root, steering.root, age.root, battery.root),
    h("div", { class: "topbar-tools" }, accessBadge(car), look, h("button", { type: "button", class: "icon-button", "aria-label": "Keys", title: "Keys (?)", onclick: showKeys }, "?")),
    words);

  car.on("hello", (hello) => {
    setText(robot, hello.robot);
    setText(graph, hello.graph);
    document.title = `${hello.robot} · carril`;
  });

  function refresh(): void {
    const found = keys();
    const fresh = <T,>(key: string | null): T | null => (car.connection.connected && (car.ageOf(key) ?? Infinity) <= LIMIT_MS ? car.value<T>(key) : null);
    const down = car.connection.downSince;
    root.classList.toggle("is-down", down !== null);
    setText(link, down === null ? "● connected" : `○ ${car.hello ? "reconnecting" : "connecting"} for ${Math.floor((performance.now() - down) / 1000)} s`);
    const round_trip = down === null ? car.clock.roundTripMs() : null;
    setText(trip, round_trip === null ? "" : round_trip < 9.95 ? `${round_trip.toFixed(1)} ms` : duration(round_trip));
    const decision = fresh<Decision>(found.state);
    const shown = lookOfDrive(decision?.state ?? null);
    setText(state, `${decision ? shown.mark : ""} ${shown.words}`.trim());
    setAttribute(state, "class", `state-chip tone-${shown.tone}`);
    setAttribute(state, "title", decision?.reason ?? null);
    const telemetry = fresh<Telemetry>(found.telemetry);
    const vehicle = fresh<Vehicle>(found.vehicle);
    setText(speed.value, fixed((telemetry ?? vehicle)?.speed_m_s, 2));
    setText(steering.value, degrees((telemetry ?? vehicle)?.steering_rad));
    const command = fresh<Command>(found.command) ? car.sample(found.command) : null;
    setText(age.value, fixed(eyeAge(car.nodes, command), 0));
    setText(battery.value, fixed(telemetry?.battery_v, 2));
    estop.disabled = !mayEstop(car);
  }
  return { root, refresh };
}
