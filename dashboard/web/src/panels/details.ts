// Everything about one node, and what can be done to it. Lies over the right column, so that the camera stays in view while a
// threshold is moved.
import type { Car } from "../car";
import { needsControl } from "../control";
import { h, setAttribute, setHidden, setText } from "../dom";
import { DASH, fixed, hertz, microseconds } from "../format";
import { bandwidthOf, flowOf, isDown, lookOf, nodeOf } from "../flow";
import { announce } from "../notices";
import { Parameter } from "../parameter";
import { readReceipt, type GraphNode, type Percentiles } from "../protocol";
import { isFields } from "../read";
import { fieldsOf } from "../schema";
import { wordsOf } from "./log";

/** Fewer are seen at a glance. */
const FIELDS_TO_SEARCH = 5;

export interface Details { root: HTMLElement; open(node: string): void; refresh(): void }

export function detailsDrawer(car: Car, shown: (node: string | null) => void): Details {
  let name: string | null = null;
  let parameters = new Map<string, Parameter>();
  let shape = "";
  let opener: Element | null = null;

  const title = h("h2", { class: "details-title", tabindex: -1 });
  const subtitle = h("p", { class: "details-sub muted" });
  const state = h("span", { class: "details-state" });
  const close = h("button", { type: "button", class: "icon-button", "aria-label": "Close details", onclick: () => shut() }, "×");
  const error = h("p", { class: "details-error", role: "alert", hidden: true });
  const form = h("div", { class: "parameters" });
  const find = h("input", { type: "search", placeholder: "find", "aria-label": "Find a parameter", oninput: () => filter() });
  const outside = h("div", { class: "outside" });
  const facts = h("dl", { class: "facts" });
  const ports = h("div", { class: "ports" });
  const act = (what: string, text: string, help: string) => needsControl(car, h("button", { type: "button", title: help, onclick: () => void change({ type: what }, text) }, text));
  const operator = needsControl(car, h("select", { name: "operator", "aria-label": "Operator" }));
  const operatorHint = h("span", { class: "swap-hint" });
  const swap = swapForm();
  const swapToggle = needsControl(car, h("button", { type: "button", title: "Another version or operator, while the car drives", "aria-expanded": "false", onclick: () => showSwap(swap.hidden) }, "Swap…"));
  const root = h("aside", { class: "details", "aria-label": "Node", hidden: true },
    h("header", { class: "details-head" }, h("div", { class: "details-names" }, h("div", { class: "details-title-line" }, title, state), subtitle), close),
    h("div", { class: "details-body" }, error, h("p", { class: "read-only-note" }, "read only: values can be seen, not changed"),
      h("div", { class: "details-actions" }, act("restart", "Restart", "Anew, without its state; also a node that gave up"), act("rollback", "Rollback", "Back to what was there before the last change"), swapToggle), swap,
      h("div", { class: "details-section" }, h("h3", {}, "Parameters"), find), form, outside, h("h3", {}, "Health"), facts, h("h3", {}, "Ports"), ports));

  window.addEventListener("keydown", (event) => {
    if (event.key === "Escape" && !root.hidden && !document.querySelector("dialog[open]")) shut();
  });

  function swapForm(): HTMLFormElement {
    const values = needsControl(car, h("textarea", { name: "values", rows: 2, placeholder: '{"threshold": 180}', "aria-label": "Changed values, JSON", spellcheck: "false" }));
    const fresh = needsControl(car, h("input", { type: "checkbox", name: "fresh" }));
    const problem = h("p", { class: "problem", role: "alert" });
    const submit = needsControl(car, h("button", { type: "submit", class: "primary" }, "Swap"));
    const send = (event: Event) => {
      event.preventDefault();
      let changed: unknown = {};
      try {
        changed = values.value.trim() === "" ? {} : JSON.parse(values.value);
      } catch (error) {
        return setText(problem, `changed values are no JSON: ${(error as Error).message}`);
      }
      if (!isFields(changed)) return setText(problem, "changed values must be an object: {\"name\": value}");
      setText(problem, "");
      void change({ type: "swap", operator: operator.value || null, values: changed, fresh: fresh.checked }, "Swap");
    };
    return h("form", { class: "swap", hidden: true, onsubmit: send }, h("label", {}, "Operator", operator, operatorHint), h("label", {}, "Changed values", values), h("label", { class: "check" }, fresh, "fresh: without the state of the old one"), problem, submit);
  }

  /** Those that the car says fit. What is chosen stays chosen while the graph tells of something else. */
  function offerOperators(found: GraphNode): void {
    const names = ["", ...found.fitting];
    const chosen = operator.value;
    operator.replaceChildren(...names.map((each) => h("option", { value: each }, each || `${found.operator}, as now`)));
    operator.value = names.includes(chosen) ? chosen : "";
    setText(operatorHint, found.fitting.length > 0 ? "" : "no other operator of this build has the ports that are wired here");
  }

  function showSwap(visible: boolean): void {
    setHidden(swap, !visible);
    setAttribute(swapToggle, "aria-expanded", String(visible));
  }

  async function change(message: { type: string; [key: string]: unknown }, what: string): Promise<void> {
    if (!name) return;
    try {
      const receipt = readReceipt(await car.connection.request({ ...message, node: name }));
      announce(receipt.outcome === "done" ? "good" : "bad", wordsOf(receipt));
      if (receipt.outcome === "done") showSwap(false);
    } catch (error) {
      announce("bad", `${what} of ${name}: ${(error as Error).message}`);
    }
  }

  function open(node: string): void {
    if (root.hidden) opener = document.activeElement;
    if (node !== name) {
      showSwap(false);
      swap.reset();
    }
    name = node;
    shape = "";
    setHidden(root, false);
    shown(node);
    refreshConfig();
    refresh();
    title.focus({ preventScroll: true });
  }

  function shut(): void {
    name = null;
    setHidden(root, true);
    shown(null);
    if (opener instanceof HTMLElement || opener instanceof SVGElement) opener.focus({ preventScroll: true });
  }

  const node = (): GraphNode | undefined => car.nodes.find((each) => each.name === name);

  function refreshConfig(): void {
    const found = node();
    if (!found) {
      if (name && car.nodes.length > 0) shut();
      return;
    }
    offerOperators(found);
    const fields = fieldsOf(found.schema, found.config);
    const nextShape = JSON.stringify([found.name, found.operator, fields.map((field) => [field.path, field.kind])]);
    if (nextShape !== shape) {
      shape = nextShape;
      find.value = "";
      setHidden(find, fields.length < FIELDS_TO_SEARCH);
      parameters = new Map(fields.map((field) => [field.path, new Parameter(car, found.name, field)]));
      outside.replaceChildren(...outsideForms(found));
      form.replaceChildren(...[...parameters.values()].map((each) => each.root), fields.length === 0 ? h("p", { class: "muted" }, "none") : "");
    } else for (const field of fields) parameters.get(field.path)?.inForce(field);
  }

  function filter(): void {
    for (const each of parameters.values()) each.filter(find.value);
  }

  /** Inputs that people feed. Driving by hand has a panel of its own, since one command alone is stale at once. */
  function outsideForms(found: GraphNode): HTMLElement[] {
    const drive = car.hello?.drive;
    const inputs = found.inputs.filter((input) => input.external && !(drive && drive.node === found.name && drive.port === input.port));
    const forms = inputs.map((input) => {
      const value = needsControl(car, h("input", { class: "parameter-json", placeholder: input.message_type === "carril/Goal" ? '{"cruise": {"speed_m_s": 0.4}}' : "JSON", "aria-label": `Value for ${input.port}`, spellcheck: "false", autocomplete: "off" }));
      const problem = h("p", { class: "parameter-reason", role: "alert" });
      const send = async (event: Event) => {
        event.preventDefault();
        setText(problem, "");
        try {
          await car.connection.request({ type: "pub", key: `${found.name}/${input.port}`, value: JSON.parse(value.value) });
          announce("good", `sent to ${found.name}/${input.port}`);
        } catch (error) {
          setText(problem, (error as Error).message);
        }
      };
      return h("form", { class: "parameter", onsubmit: (event: Event) => void send(event) }, h("div", { class: "parameter-head" }, h("span", { class: "parameter-name" }, input.port, h("span", { class: "unit" }, input.message_type.replace("carril/", "")))),
        h("div", { class: "parameter-edit" }, value, needsControl(car, h("button", { type: "submit" }, "Send"))), problem);
    });
    return forms.length > 0 ? [h("h3", {}, "Inputs from outside"), ...forms] : [];
  }

  const percentiles = (value: Percentiles | null, unit: (each: number) => string): string => (value ? `${unit(value.p50)} / ${unit(value.p99)} / ${unit(value.max)}` : "–");

  function refresh(): void {
    const found = node();
    if (!name || !found) return;
    const status = nodeOf(car.status, name);
    const look = lookOf(status?.state ?? null);
    setText(title, name);
    setText(state, `${look.mark} ${look.words}`);
    setAttribute(state, "class", `details-state tone-${look.tone}`);
    setText(subtitle, `${found.operator} · version ${found.version} · process ${found.process}${status?.pid ? ` (${status.pid})` : ""}`);
    const trouble = [isDown(status?.state ?? null) ? "It stays down. Restart starts it again; Swap starts another version." : null, status?.last_error ? `last error: ${status.last_error}` : null].filter(Boolean).join(" ");
    setText(error, trouble);
    setHidden(error, trouble === "");
    const ms = (value: number) => `${fixed(value, 1)} ms`;
    const rows: [string, string][] = status ? [
      ["rate", hertz(status.rate_hz)], ["step p50 / p99 / max", percentiles(status.step_us, microseconds)], ["latency p50 / p99 / max", percentiles(status.latency_us, microseconds)],
      ["age p50 / p99 / max", percentiles(status.age_ms, ms)], ["overruns", String(status.overruns)], ["missed periods", String(status.missed_periods)], ["errors", String(status.errors)],
      ["restarts", String(status.restarts)], ["budget violations", String(status.budget_violations)],
    ] : [];
    facts.replaceChildren(...rows.flatMap(([label, value]) => [h("dt", {}, label), h("dd", {}, value)]));
    ports.replaceChildren(portTable("in", ["received", "dropped", "lost", "stale", "refused"], found.inputs.map((input) => {
      const counted = status?.inputs.find((each) => each.port === input.port);
      return { name: input.port, hint: input.from ? `from ${input.from}` : input.external ? "from outside" : "", problem: counted?.last_refusal ?? null, cells: counted ? [counted.received, counted.dropped, counted.lost, counted.stale, counted.refused].map(grouped) : [] };
    })), portTable("out", ["rate", "bandwidth", "sent"], found.outputs.map((output) => {
      const counted = status?.outputs.find((each) => each.port === output.port);
      const flow = flowOf(car.statusBefore, car.status, `${found.name}/${output.port}`);
      return { name: output.port, hint: `${output.message_type.replace("carril/", "")}${output.on_demand ? ", on demand" : ""}`, problem: null, cells: counted ? [flow ? hertz(flow.rate_hz) : DASH, (flow && bandwidthOf(flow)) || DASH, grouped(counted.sent)] : [] };
    })));
  }

  interface Row { name: string; hint: string; problem: string | null; cells: string[] }
  const grouped = (count: number): string => count.toLocaleString("en");
  function portTable(title: string, heads: string[], rows: Row[]): HTMLElement {
    if (rows.length === 0) return h("p", { class: "muted" }, title === "in" ? "no inputs" : "no outputs");
    const body = rows.flatMap((row) => [
      h("tr", {}, h("th", { scope: "row" }, row.name, h("span", { class: "port-hint" }, row.hint)), ...heads.map((_, at) => h("td", {}, row.cells[at] ?? DASH))),
      ...(row.problem ? [h("tr", {}, h("td", { class: "tone-bad port-problem", colspan: heads.length + 1 }, `last refusal: ${row.problem}`))] : []),
    ]);
    return h("table", { class: "port-table" }, h("thead", {}, h("tr", {}, h("th", { scope: "col" }, title), ...heads.map((head) => h("th", { scope: "col" }, head)))), h("tbody", {}, ...body));
  }

  car.on("graph", () => {
    refreshConfig();
    refresh();
  });
  car.on("status", refresh);
  return { root, open, refresh };
}
