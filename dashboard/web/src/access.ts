// Who may do what: the badge, and the form to log in. The token goes to the server once and is never kept by the page.
import type { Car } from "./car";
import { h, setHidden, setText, withCode } from "./dom";
import { announce } from "./notices";
import { fields, text } from "./read";

async function post(path: string, body: object): Promise<string | null> {
  try {
    const response = await fetch(path, { method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(body) });
    if (response.ok) return null;
    const answer = fields(await response.json().catch(() => ({})));
    return text(answer.error) ?? `the server answered ${response.status}`;
  } catch {
    return "the server did not answer";
  }
}

export function accessBadge(car: Car): HTMLElement {
  const [mark, roomy, brief] = [h("span"), h("span", { class: "roomy" }), h("span")];
  const badge = h("button", { type: "button", class: "access-badge", "aria-haspopup": "dialog", onclick: () => dialog.showModal() }, mark, roomy, brief);
  const why = h("p", { class: "dialog-why" });
  const name = h("input", { name: "name", autocomplete: "username", placeholder: "laptop-1", required: true });
  const token = h("input", { name: "token", type: "password", autocomplete: "current-password", required: true });
  const problem = h("p", { class: "problem", role: "alert" });
  const login = h("form", { class: "dialog-form", onsubmit: (event: Event) => { event.preventDefault(); void logIn(); } },
    h("label", {}, "Name", name), h("label", {}, "Token", token), problem,
    h("div", { class: "dialog-row" }, h("button", { type: "submit", class: "primary" }, "Log in")));
  const logout = h("button", { type: "button", onclick: () => void logOut() }, "Log out");
  const close = h("button", { type: "button", class: "icon-button dialog-close", "aria-label": "Close", onclick: () => dialog.close() }, "×");
  const dialog = h("dialog", { class: "dialog", "aria-label": "Access" }, close, h("h2", {}, "Access"), why, login, logout);

  async function logIn(): Promise<void> {
    setText(problem, "");
    const error = await post("/api/login", { name: name.value, token: token.value });
    token.value = "";
    if (error) return setText(problem, error);
    dialog.close();
    car.connection.reopen();
  }

  async function logOut(): Promise<void> {
    const error = await post("/api/logout", {});
    if (error) return announce("bad", `Log out: ${error}`);
    dialog.close();
    car.connection.reopen();
  }

  car.on("access", (access) => {
    const control = access.level === "control";
    setText(mark, control ? "✓ " : "◌ ");
    setText(roomy, control && access.name ? "control as " : "");
    setText(brief, control ? (access.name ?? "control") : car.hello?.can_log_in ? "read only · log in" : "read only");
    badge.className = `access-badge ${control ? "has-control" : "has-read"}`;
    badge.title = access.why;
    why.replaceChildren(...withCode(`${control ? `You control this car${access.name ? ` as ${access.name}` : ""}` : "You may look, not touch"}${access.why ? `: ${access.why}` : ""}.`));
    setHidden(login, control || !car.hello?.can_log_in);
    setHidden(logout, !(control && access.name && car.hello?.can_log_in));
  });
  return h("div", { class: "access" }, badge, dialog);
}
