// What the car is doing and why, now and in its last states.
import type { Car } from "../car";
import { h, setAttribute, setText } from "../dom";
import { duration, shortTime, timeOfDay } from "../format";
import { lookOfDrive } from "../flow";
import { Panel } from "../panel";
import { firstKey } from "../roles";
import { Transitions } from "../transitions";
import type { Decision } from "../values";

export function decisionPanel(car: Car): Panel {
  const key = () => firstKey(car.nodes, "carril/DecisionState");
  const history = new Transitions();
  const panel = new Panel(car, {
    id: "decision", title: "Decision", limit_ms: 1000, age: () => car.ageOf(key()), absent: () => (car.nodes.length > 0 && !key() ? "this graph has no decision node" : null),
  });
  const mark = h("span", { class: "state-mark", "aria-hidden": true });
  const state = h("span", { class: "state-name", id: "state", role: "status", "aria-live": "polite" }, "–");
  const since = h("span", { class: "state-since" });
  const reason = h("p", { class: "state-reason" });
  const rows = h("ol", { class: "transitions", "aria-label": "Last transitions", tabindex: 0 });
  panel.body.append(h("div", { class: "state-line" }, mark, state, since), reason, rows);

  car.on("sample", (sample) => {
    if (sample.key !== key()) return;
    const decision = sample.value as Decision;
    const look = lookOfDrive(decision.state);
    setText(mark, look.mark);
    setText(state, look.words);
    setAttribute(mark, "class", `state-mark tone-${look.tone}`);
    setAttribute(state, "class", `state-name tone-${look.tone}`);
    setText(since, `for ${duration(sample.time_ms - decision.since_ms)}`);
    setText(reason, decision.reason);
    if (history.take(decision)) show();
  });
  car.on("hello", () => {
    history.clear();
    show();
  });

  function show(): void {
    rows.replaceChildren(...history.newestFirst().map((entry) => {
      const look = lookOfDrive(entry.state);
      return h("li", {}, h("span", { class: "muted mono", title: timeOfDay(entry.since_ms) }, shortTime(entry.since_ms)), h("span", { class: `tone-${look.tone} transition-state` }, `${look.mark} ${look.words}`), h("span", { class: "transition-reason", title: entry.reason }, entry.missed > 0 ? `${entry.reason} (${entry.missed} before it not seen)` : entry.reason));
    }));
  }
  return panel;
}
