// Faults, in words, where nobody overlooks them: of the graph, of the microcontroller, of the connection.
import type { Car } from "./car";
import { needsControl, say } from "./control";
import { h, setHidden, setText } from "./dom";
import { firstKey } from "./roles";
import { faultTexts, type Telemetry } from "./values";

export function banner(car: Car): { root: HTMLElement; refresh(): void } {
  const text = h("span", { class: "banner-text" });
  const reset = needsControl(car, h("button", { type: "button", onclick: () => void say(car, "reset") }, "Reset"));
  const root = h("div", { class: "banner", role: "alert", hidden: true }, h("span", { class: "banner-mark", "aria-hidden": true }, "▲"), text, reset);

  function refresh(): void {
    const fault = car.status?.fault;
    const telemetryKey = firstKey(car.nodes, "carril/WheelTelemetry");
    const fresh = (car.ageOf(telemetryKey) ?? Infinity) < 1000;
    const chip = fresh ? faultTexts(car.value<Telemetry>(telemetryKey)?.faults ?? 0) : [];
    const faults = [fault ? `${fault.node}: ${fault.reason}` : null, ...chip.map((each) => `microcontroller: ${each}`)].filter(Boolean);
    const gone = car.status?.nodes.filter((node) => node.state === "gave-up").map((node) => `${node.node} gave up: its details in the graph have Restart`) ?? [];
    const words = [...faults, ...gone].join(" · ");
    const down = car.hello !== null && !car.connection.connected;
    setText(text, down ? `Not connected${car.goodbye ? `: ${car.goodbye}` : ""}. What is shown is old, and no button reaches the car.` : words);
    setHidden(reset, down || faults.length === 0);
    setHidden(root, !down && (words === "" || !car.connection.connected));
  }
  return { root, refresh };
}
