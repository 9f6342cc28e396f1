// Driving by hand, from keys, a pad on the screen, or a gamepad. Off until switched on; whatever goes wrong ends it: a released key,
// a hidden tab, a lost focus, a lost connection, a lost right.
import type { Car } from "../car";
import { needsControl } from "../control";
import { h, isTyping, setAttribute, setHidden, setText } from "../dom";
import { Beat, DRIVE_KEYS, Ramp, commandOf, wishOfGamepad, wishOfKeys, type Wish } from "../drive";
import { degrees, fixed } from "../format";
import { recall, remember } from "../memory";
import { announce } from "../notices";
import type { DriveTerms } from "../protocol";

const wheel = {
  now: () => performance.now(),
  later: (ms: number, action: () => void) => {
    const timer = window.setTimeout(action, ms);
    return () => window.clearTimeout(timer);
  },
};

export function drivePanel(car: Car): HTMLElement {
  const held = new Set<string>();
  const ramp = new Ramp();
  let on = false;
  let padWish: Wish | null = null;
  let seq = 0;
  let sending = false;
  let refused: string | null = null;
  let acknowledged = false;

  const toggle = needsControl(car, h("input", { type: "checkbox", role: "switch", id: "drive-switch", onchange: () => setOn(toggle.checked) }));
  const label = h("label", { class: "drive-switch", for: "drive-switch" }, toggle, h("span", { class: "switch-track", "aria-hidden": true }), "Drive by hand");
  const status = h("span", { class: "drive-status", id: "drive-status", role: "status" });
  const limit = h("input", { type: "range", min: 0.05, max: 1, step: 0.05, value: 0.5, "aria-label": "Speed limit", oninput: () => { remember("drive.limit", limit.value); showLimit(); } });
  const limitText = h("span", { class: "drive-limit-text" });
  const knob = h("span", { class: "pad-knob" });
  const pad = h("div", { class: "pad", "aria-label": "Hold and pull to drive", role: "application" }, h("span", { class: "pad-cross", "aria-hidden": true }), knob);
  const keys = h("span", { class: "drive-keys muted" }, "hold W A S D, arrows, the pad, or a gamepad's shoulder button");
  const live = h("div", { class: "drive-live", hidden: true }, pad, h("div", { class: "drive-side" }, h("label", { class: "drive-limit" }, "limit", limit, limitText), keys));
  const root = h("section", { class: "drive", id: "drive", "aria-label": "Drive by hand" }, h("div", { class: "drive-line" }, label, status), live);

  const maxSpeed = () => Math.min(Number(limit.value), car.hello?.drive?.max_speed_m_s ?? 0);
  const beat = new Beat(wheel, (elapsed_s) => send(elapsed_s));

  function setOn(next: boolean): void {
    on = next && car.inControl && Boolean(car.hello?.drive);
    toggle.checked = on;
    root.classList.toggle("is-on", on);
    setHidden(live, !on);
    if (on) {
      beat.start(); // it also reads the gamepad, which sends no events
      toggle.blur(); // else the arrow keys belong to the switch
    } else {
      letGo();
      beat.stop();
    }
    refused = null;
    show(null);
  }

  /** Nothing is held any more. The car hears of it at once, not by the end of its lease. */
  function letGo(): void {
    held.clear();
    padWish = null;
    end();
  }

  function end(): void {
    ramp.reset();
    moveKnob(null);
    if (!sending) return;
    sending = acknowledged = false;
    car.connection.send({ type: "drive_end" });
    show(null);
  }

  const gamepadWish = (): Wish | null => {
    for (const each of navigator.getGamepads?.() ?? []) {
      const wish = each?.mapping === "standard" ? wishOfGamepad(each) : null;
      if (wish) return wish;
    }
    return null;
  };

  function send(elapsed_s: number): void {
    const terms = car.hello?.drive;
    if (!on || !terms || document.hidden || !document.hasFocus()) return end();
    const keyWish = wishOfKeys(held);
    const wish = padWish ?? gamepadWish() ?? (keyWish && ramp.step(keyWish, elapsed_s));
    if (!wish) return end();
    if (!padWish) moveKnob(wish);
    const command = commandOf(wish, { max_speed_m_s: maxSpeed(), max_steering_rad: terms.max_steering_rad });
    seq += 1;
    if (!car.connection.send({ type: "drive", seq, ...command, seen_ms: car.connection.seen_ms })) return setOn(false);
    sending = true;
    show(command);
  }

  function show(command: { steering_rad: number; speed_m_s: number } | null): void {
    const words = !car.hello?.drive ? "this graph has no manual drive" : !on ? "" : command ? `${fixed(command.speed_m_s, 2)} m/s  ${degrees(command.steering_rad)}°` : "ready, nothing is sent";
    const answer = refused ? `✕ ${refused}` : command ? (acknowledged ? "✓ applied" : "… not applied yet") : "";
    setText(status, [words, answer].filter(Boolean).join("  "));
    setAttribute(status, "class", `drive-status ${refused ? "tone-bad" : command && acknowledged ? "tone-good" : "tone-idle"}`);
  }

  function showLimit(): void {
    setText(limitText, `${fixed(Number(limit.value), 2)} m/s`);
  }

  window.addEventListener("keydown", (event) => {
    if (!on || !DRIVE_KEYS.has(event.code) || isTyping(event.target) || event.target instanceof HTMLInputElement && event.target.type === "range") return;
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    if (!event.repeat) held.add(event.code); // repeats of a key that was let go of for us, by a lost focus, are no new press
  });
  window.addEventListener("keyup", (event) => {
    held.delete(event.code);
    if (on && held.size === 0 && !padWish) end();
  });
  window.addEventListener("blur", letGo);
  window.addEventListener("pagehide", letGo);
  document.addEventListener("visibilitychange", () => document.hidden && letGo());

  function pull(event: PointerEvent): void {
    const box = pad.getBoundingClientRect();
    const reach = box.width / 2 - 14;
    const [x, y] = [event.clientX - box.left - box.width / 2, event.clientY - box.top - box.height / 2].map((each) => Math.max(-reach, Math.min(reach, each))) as [number, number];
    padWish = { steering: -x / reach, speed: -y / reach };
    moveKnob(padWish);
  }

  /** The knob shows what is asked, whoever asks. */
  function moveKnob(wish: Wish | null): void {
    const reach = pad.clientWidth / 2 - 14;
    knob.style.transform = wish ? `translate(${-wish.steering * reach}px, ${-wish.speed * reach}px)` : "";
  }
  pad.addEventListener("pointerdown", (event) => {
    if (!on) return;
    pad.setPointerCapture(event.pointerId);
    pull(event);
  });
  pad.addEventListener("pointermove", (event) => padWish && pull(event));
  for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) pad.addEventListener(name, letGo);
  pad.addEventListener("contextmenu", (event) => event.preventDefault());

  car.on("driveAck", (ack) => {
    acknowledged = ack.applied;
    refused = ack.applied ? null : (ack.error ?? "not applied");
  });
  car.on("connection", () => {
    if (on && !car.connection.connected) {
      setOn(false);
      announce("bad", "Driving by hand ended: the connection is lost");
    }
  });
  car.on("access", () => {
    if (on && !car.inControl) setOn(false);
  });
  function follow(terms: DriveTerms | null): void {
    const max = terms?.max_speed_m_s ?? 1;
    limit.max = String(max);
    limit.value = recall("drive.limit") ?? String(Math.min(0.5, max));
    showLimit();
    setHidden(label, !terms);
  }
  car.on("hello", (hello) => {
    setOn(false);
    follow(hello.drive);
  });
  car.on("drive", (terms) => {
    // Whoever drives goes on, within the new limits.
    if (!terms) setOn(false);
    follow(terms);
    if (!on) show(null);
  });
  show(null);
  return root;
}
