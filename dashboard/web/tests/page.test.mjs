// The page in a real browser against the mock server. Waits for what must come; never asserts how long it took.
import assert from "node:assert/strict";
import { after, before, beforeEach, afterEach, test } from "node:test";
import { existsSync } from "node:fs";
import { chromium } from "playwright-core";
import { startMock } from "../mock/server.mjs";

const executablePath = [process.env.CHROMIUM, "/usr/bin/chromium", "/usr/bin/chromium-browser", "/usr/bin/google-chrome"].find((path) => path && existsSync(path));
const ARGS = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync"];

let browser, mock, context, page, complaints;
before(async () => {
  assert.ok(executablePath, "no chromium; install it (apt-get install chromium) or name one in CHROMIUM");
  browser = await chromium.launch({ executablePath, args: ARGS });
});
after(() => browser?.close());
beforeEach(() => { complaints = []; });
afterEach(async () => {
  await context?.close();
  await mock?.close();
  context = mock = undefined;
  assert.deepEqual(complaints, [], "the console is silent: no errors, no violation of the content security policy");
});

/** A page on a mock with these options. `expected`: console errors that belong to the test. */
async function open(options = {}, { size = { width: 1280, height: 800 }, phone = false, expected = [] } = {}) {
  mock = await startMock(options);
  context = await browser.newContext({ viewport: size, hasTouch: phone, isMobile: phone });
  page = await context.newPage();
  page.setDefaultTimeout(20_000);
  page.on("console", (message) => {
    if (["error", "warning"].includes(message.type()) && !expected.some((each) => each.test(message.text()))) complaints.push(message.text());
  });
  page.on("pageerror", (error) => complaints.push(String(error)));
  page.on("request", (request) => {
    if (!request.url().startsWith(mock.url) && !request.url().startsWith("blob:")) complaints.push(`request to ${request.url()}`);
  });
  await page.goto(mock.url);
  await page.locator(".link-state", { hasText: "connected" }).waitFor();
  return page;
}

const of = (type) => mock.received.filter((message) => message.type === type);
async function until(what, condition) {
  const give_up = Date.now() + 20_000;
  while (!(await condition())) {
    assert.ok(Date.now() < give_up, `never came: ${what}`);
    await new Promise((done) => setTimeout(done, 30));
  }
}
const text = (selector) => page.locator(selector).first().textContent();
const picture = () => page.locator(".camera-canvas").evaluate((canvas) => canvas.toDataURL());
const asked = () => of("subscribe").at(-1)?.keys.map((each) => each.key) ?? [];

test("shows robot, state and live figures", async () => {
  await open();
  assert.equal(await text(".robot"), "car1");
  await until("the state", async () => (await text("#state")) === "lane-follow");
  await until("battery", async () => /^7\.\d\d$/.test(await text("#top-battery")));
  await until("age of the command", async () => /^\d+$/.test(await text("#top-age")));
});

test("frames change, are acknowledged, and their overlay can be switched", async () => {
  await open();
  await until("two frames", () => of("ack").filter((ack) => ack.key === "world/camera").length >= 2);
  const first = await picture();
  await until("another picture", async () => (await picture()) !== first);
  assert.ok(!asked().includes("lane/debug"), "the mask is not made while nobody looks");
  await page.getByRole("button", { name: "mask" }).click();
  await until("the mask is asked for", () => asked().includes("lane/debug"));
  await until("the mask came", () => of("ack").some((ack) => ack.key === "lane/debug"));
  await page.getByRole("button", { name: "mask" }).click();
  await until("the mask is given up", () => !asked().includes("lane/debug"));
});

test("tells what the pixel under the pointer is worth", async () => {
  await open();
  await until("a frame", () => of("ack").length > 0);
  const box = await page.locator(".camera-canvas").boundingBox();
  await page.mouse.move(box.x + box.width / 2, box.y + box.height * 0.1);
  await until("the pixel", async () => /x 3\d\d y \d+ +grey \d+ +rgb \d+ \d+ \d+ +hsv \d+ \d+ \d+/.test(await text("#pixel")));
  await page.mouse.move(box.x - 5, box.y);
  await until("the hint again", async () => (await text("#pixel")).startsWith("point at"));
});

test("saves what is shown, named after robot, key and time", async () => {
  await open();
  await until("a frame", () => of("ack").length > 0);
  const [download] = await Promise.all([page.waitForEvent("download"), page.getByRole("button", { name: "Snapshot" }).click()]);
  assert.match(download.suggestedFilename(), /^car1_world-camera_20\d\d-.*\.png$/);
});

test("a slider sets the parameter and shows that it is in force", async () => {
  await open();
  await page.locator('[data-node="lane"]').click();
  const parameter = page.locator('[data-path="threshold"]');
  await parameter.locator('input[type="range"]').focus();
  await page.keyboard.press("ArrowRight");
  await until("the set", () => of("set").length > 0);
  assert.ok(of("set")[0].values.threshold > 190, JSON.stringify(of("set")[0]));
  await until("done", async () => (await parameter.locator(".parameter-state").textContent()) === "✓");
  assert.equal(Number(await parameter.locator(".parameter-number").inputValue()), mock.node("lane").config.threshold);
  await until("the receipt in the log", async () => (await page.locator(".log-text").allTextContents()).some((line) => line.startsWith("set of lane: done")));
});

test("what is refused says why and goes back to what is in force", async () => {
  await open();
  await page.locator('[data-node="lane"]').focus();
  await page.keyboard.press("Enter");
  const parameter = page.locator('[data-path="row_far"]');
  await parameter.locator(".parameter-number").fill("0.9");
  await page.keyboard.press("Enter");
  await until("the reason", async () => /must be above/.test(await parameter.locator(".parameter-reason").textContent()));
  assert.equal(Number(await parameter.locator('input[type="range"]').inputValue()), 0.75);
  await parameter.locator('input[type="range"]').focus();
  await page.keyboard.press("End");
  await until("the slider is back", async () => of("set").length >= 2 && Number(await parameter.locator('input[type="range"]').inputValue()) === 0.75);
  assert.equal(of("set").at(-1).values.row_far, 1);
  assert.equal(mock.node("lane").config.row_far, 0.75);
  await page.keyboard.press("Escape");
  await until("closed", async () => !(await page.locator(".details").isVisible()));
});

test("restart, rollback and swap reach the server", async () => {
  await open();
  await page.locator('[data-node="lane"]').click();
  await page.getByRole("button", { name: "Restart" }).click();
  await page.getByRole("button", { name: "Rollback" }).click();
  await page.getByRole("button", { name: "Swap…" }).click();
  await page.getByLabel("Changed values").first().fill('{"threshold": 170}');
  await page.getByRole("button", { name: "Swap", exact: true }).click();
  await until("all three", () => of("restart").length === 1 && of("rollback").length === 1 && of("swap").length === 1);
  assert.deepEqual(of("swap")[0].values, { threshold: 170 });
  assert.equal(of("swap")[0].operator, null);
});

test("the swap form offers the operators that fit, and keeps what is chosen", async () => {
  await open();
  const options = () => page.getByLabel("Operator").locator("option").allTextContents();
  await page.locator('[data-node="lane"]').click();
  await page.getByRole("button", { name: "Swap…" }).click();
  assert.deepEqual(await options(), ["lane-detector, as now"]);
  assert.match(await text(".swap-hint"), /no other operator/);
  await page.locator('[data-node="mcu"]').click();
  await page.getByRole("button", { name: "Swap…" }).click();
  assert.deepEqual(await options(), ["sim-mcu, as now", "sim-avr"]);
  await page.getByLabel("Operator").selectOption("sim-avr");
  mock.tellAll({ type: "graph", nodes: mock.graph });
  await page.getByRole("button", { name: "Swap", exact: true }).click();
  await until("the swap", () => of("swap").length === 1);
  assert.deepEqual([of("swap")[0].node, of("swap")[0].operator], ["mcu", "sim-avr"]);
});

test("other limits of driving by hand come while one drives", async () => {
  await open();
  await page.locator(".drive-switch").click();
  await page.keyboard.down("ArrowUp");
  await until("driving", () => of("drive").length > 3);
  mock.tellAll({ type: "drive_terms", drive: { node: "decision", port: "manual", max_speed_m_s: 0.2, max_steering_rad: 0.349, lease_ms: 300 } });
  await until("within the new limit", () => Math.abs(of("drive").at(-1).speed_m_s - 0.2) < 1e-9);
  assert.ok(await page.locator("#drive-switch").isChecked(), "it goes on");
  mock.tellAll({ type: "drive_terms", drive: null });
  await until("the end", () => of("drive_end").length === 1);
  assert.ok(!(await page.locator(".drive-switch").isVisible()), "there is nothing to switch on");
  mock.tellAll({ type: "drive_terms", drive: { node: "decision", port: "manual", max_speed_m_s: 1, max_steering_rad: 0.349, lease_ms: 300 } });
  await until("there it is again", () => page.locator(".drive-switch").isVisible());
  assert.match(await text(".drive-limit-text"), /0\.50/, "the limit is the driver's own again");
  await page.keyboard.up("ArrowUp");
});

test("every edge shows its rate and bandwidth", async () => {
  await open();
  const labels = () => page.locator(".edge-label").allTextContents();
  await until("figures on all edges", async () => (await labels()).every((label) => /^[\d.]+ (Hz|[kM]?B\/s)$/.test(label)));
  const all = await labels();
  assert.ok(all.length === 2 * 8 && all.filter((label) => label.endsWith("Hz")).length === 8 && all.some((label) => /^\d+ MB\/s$/.test(label)), all.join(", "));
});

test("e-stop by button and by space, reset by button", async () => {
  await open();
  await page.locator("#estop").click();
  await until("e-stop", async () => (await text("#state")) === "e-stop");
  await page.getByRole("button", { name: "Reset" }).first().click();
  await until("idle", async () => (await text("#state")) === "idle");
  await page.getByRole("button", { name: "Start" }).click();
  await until("lane-follow", async () => (await text("#state")) === "lane-follow");
  await page.getByRole("button", { name: "Stop", exact: true }).focus();
  await page.keyboard.press("Space");
  await until("e-stop", async () => (await text("#state")) === "e-stop");
  assert.deepEqual(of("control").map((each) => each.word), ["estop", "reset", "start", "estop"], "space on a focused button is the e-stop, not a click");
});

test("a space typed into a field is no e-stop", async () => {
  await open();
  await page.getByLabel("Filter text").fill("");
  await page.getByLabel("Filter text").press("Space");
  await page.getByLabel("Filter text").press("x");
  assert.equal(await page.getByLabel("Filter text").inputValue(), " x");
  assert.equal(of("control").length, 0);
});

test("read only: everything is locked but the e-stop, and the log-in form gives control", async () => {
  await open({ access: "read" });
  assert.match(await text(".access-badge"), /read only/);
  await page.locator('[data-node="lane"]').click();
  for (const name of ["Start", "Stop", "Reset", "Restart", "Rollback"]) assert.ok(await page.getByRole("button", { name, exact: true }).first().isDisabled(), name);
  assert.ok(await page.locator("#drive-switch").isDisabled());
  const inputs = page.locator(".parameter input, .parameter select");
  assert.ok((await inputs.count()) > 5);
  for (const input of await inputs.all()) assert.ok(await input.isDisabled());
  await page.keyboard.press("Space");
  await until("e-stop", async () => (await text("#state")) === "e-stop");
  await page.keyboard.press("Escape");
  await page.locator(".access-badge").click();
  await page.getByLabel("Name").fill("laptop-2");
  await page.getByLabel("Token").fill("secret");
  await page.getByRole("button", { name: "Log in", exact: true }).click();
  await until("control", async () => /control as laptop-1/.test(await text(".access-badge")));
  await until("unlocked", () => page.getByRole("button", { name: "Start" }).isEnabled());
});

test("a wrong token says so", async () => {
  await open({ access: "read" }, { expected: [/401/] });
  await page.locator(".access-badge").click();
  await page.getByLabel("Name").fill("x");
  await page.getByLabel("Token").fill("wrong");
  await page.getByRole("button", { name: "Log in", exact: true }).click();
  await until("the reason", async () => /wrong token/.test(await text(".dialog .problem")));
});

test("when the server goes everything is stale, and comes back by itself", async () => {
  await open({}, { expected: [/WebSocket|ERR_CONNECTION/] });
  await until("a frame", () => of("ack").length > 0);
  const { port } = mock;
  await mock.close();
  await until("reconnecting", async () => /reconnecting for \d+ s/.test(await text(".link-state")) && /the graph has ended/.test(await text(".banner-text")));
  await until("stale", async () => (await page.locator(".panel.is-stale").count()) >= 6);
  assert.ok(await page.getByRole("button", { name: "Start" }).isDisabled(), "no button pretends to work");
  assert.equal(await text("#top-speed"), "–", "no old figure looks new");
  mock = await startMock({ port });
  await until("connected", async () => /connected/.test(await text(".link-state")));
  await until("fresh again", async () => (await page.locator(".panel.is-stale").count()) === 0);
  await until("asked again", () => asked().includes("world/camera"));
});

test("a server that is slow to accept gets several tries, and the late ones end without a complaint", async () => {
  await open({ slowUpgrade_ms: 1300 });
  await until("the late ones have ended", () => mock.clients.size === 1);
  await until("fresh", async () => (await page.locator(".panel.is-stale").count()) === 0);
});

test("data that stop while the connection lives are stale", async () => {
  await open({ stall: true, stallAfter_ms: 3000 });
  await until("stale with its age", async () => /^stale: \d+\.\d s$/.test(await text("#camera .panel-veil")) && /^stale/.test(await text("#lidar .panel-veil")));
  assert.ok(!(await page.locator("#graph").evaluate((each) => each.classList.contains("is-stale"))), "the status still comes");
  assert.match(await text(".link-state"), /connected/);
});

test("a fault shows a banner with its reason", async () => {
  await open({ broken: "lane" });
  await until("the banner", () => page.locator(".banner").isVisible());
  assert.match(await text(".banner-text"), /lane: step failed 3 times/);
  await until("the node", async () => /faulted/.test((await page.locator('[data-node="lane"]').getAttribute("aria-label")) ?? ""));
});

test("a node that gave up is pointed out, and started again", async () => {
  await open({ gone: "lane" });
  await until("the banner", async () => /lane gave up: its details in the graph have Restart/.test(await text(".banner-text")));
  assert.ok(!(await page.locator(".banner").getByRole("button", { name: "Reset" }).isVisible()), "a reset would not help");
  await page.locator('[data-node="lane"]').click();
  assert.match(await text(".details-error"), /Restart starts it again/);
  await page.getByRole("button", { name: "Restart" }).click();
  await until("it runs", async () => !(await page.locator(".banner").isVisible()) && !(await page.locator(".details-error").isVisible()));
  assert.deepEqual(of("restart").map((each) => each.node), ["lane"]);
});

test("bad messages are counted in the log and break nothing", async () => {
  await open();
  for (const client of mock.clients) {
    for (const bad of ["no json", "[]", '{"type":"sample","key":"lane/lane","time_ms":1,"message_type":"carril/LaneEstimate","value":{"lane":7}}', '{"type":"status"}', '{"type":"graph","nodes":[{}]}']) client.socket.send(bad);
    client.socket.send(Buffer.from([255, 255, 255, 255, 0]));
  }
  await until("the sixth", async () => (await page.locator(".log-text").allTextContents()).some((line) => /message 6 that this page cannot read/.test(line)));
  const first = await picture();
  await until("still alive", async () => (await picture()) !== first);
});

test("drives by hand while a key is held, and says so when it is let go", async () => {
  await open();
  await page.keyboard.press("ArrowUp");
  assert.equal(of("drive").length, 0, "off by default");
  await page.locator(".drive-switch").click();
  await page.keyboard.down("ArrowUp");
  await page.keyboard.down("KeyA");
  await until("a dozen commands", () => of("drive").length > 12);
  await page.keyboard.up("ArrowUp");
  await page.keyboard.up("KeyA");
  await until("the end", () => of("drive_end").length === 1);
  const sent = of("drive");
  assert.ok(sent.at(-1).seq > sent[0].seq && sent.some((each) => each.speed_m_s > 0 && each.steering_rad > 0), JSON.stringify(sent.at(-1)));
  assert.ok(sent.every((each) => each.speed_m_s <= 0.5 + 1e-9 && Math.abs(each.steering_rad) <= 0.349), "within the limits");
  assert.ok(sent.at(-1).seen_ms > sent[0].seen_ms, "what was seen goes on");
  await page.waitForTimeout(150);
  assert.equal(of("drive").length, sent.length, "nothing after the end");
});

test("the on-screen pad drives while it is held", async () => {
  await open();
  await page.locator(".drive-switch").click();
  const box = await page.locator(".pad").boundingBox();
  await page.mouse.move(box.x + box.width / 2, box.y + box.height / 2);
  await page.mouse.down();
  await page.mouse.move(box.x + box.width * 0.9, box.y + box.height * 0.1, { steps: 4 });
  await until("to the right, ahead", () => of("drive").some((each) => each.steering_rad < -0.1 && each.speed_m_s > 0.1));
  await page.mouse.up();
  await until("the end", () => of("drive_end").length === 1);
});

test("a gamepad drives while its shoulder button is held", async () => {
  await open();
  await page.evaluate(() => {
    const buttons = [...Array(17)].map(() => ({ pressed: false, value: 0 }));
    window.pad = { mapping: "standard", axes: [-0.5, 0, 0, 0], buttons };
    navigator.getGamepads = () => [null, window.pad];
    buttons[7] = { pressed: true, value: 1 };
  });
  await page.locator(".drive-switch").click();
  await page.waitForTimeout(150);
  assert.equal(of("drive").length, 0, "not without the dead man's switch");
  await page.evaluate(() => { window.pad.buttons[5] = { pressed: true, value: 1 }; });
  await until("to the left, ahead", () => of("drive").some((each) => each.steering_rad > 0.1 && each.speed_m_s > 0.4));
  await page.evaluate(() => { window.pad.buttons[5] = { pressed: false, value: 0 }; });
  await until("the end", () => of("drive_end").length === 1);
});

test("driving ends with the connection, and does not go on by itself when it is back", async () => {
  await open({}, { expected: [/WebSocket|ERR_CONNECTION/] });
  await page.locator(".drive-switch").click();
  await page.keyboard.down("ArrowUp");
  await until("driving", () => of("drive").length > 3);
  const { port } = mock;
  await mock.close();
  mock = await startMock({ port });
  await until("connected", () => mock.clients.size === 1 && of("subscribe").length > 0);
  await until("fresh", async () => (await page.locator(".panel.is-stale").count()) === 0);
  assert.equal(of("drive").length, 0, "the key is still held, and nothing is sent");
  assert.ok(!(await page.locator("#drive-switch").isChecked()));
});

test("a lost focus and a hidden tab end driving and subscriptions", async () => {
  await open();
  await page.locator(".drive-switch").click();
  await page.keyboard.down("ArrowUp");
  await until("driving", () => of("drive").length > 3);
  await page.evaluate(() => window.dispatchEvent(new Event("blur")));
  await until("the end", () => of("drive_end").length === 1);
  await page.keyboard.up("ArrowUp");
  await page.keyboard.down("ArrowUp");
  const before = of("drive").length;
  await until("driving again", () => of("drive").length > before + 3);
  await page.evaluate(() => {
    Object.defineProperty(document, "hidden", { configurable: true, get: () => true });
    document.dispatchEvent(new Event("visibilitychange"));
  });
  await until("the end", () => of("drive_end").length === 2);
  await until("nothing is asked for", () => asked().length === 0);
  const stopped = of("drive").length;
  await page.waitForTimeout(150);
  assert.equal(of("drive").length, stopped);
  await page.evaluate(() => {
    Object.defineProperty(document, "hidden", { configurable: true, get: () => false });
    document.dispatchEvent(new Event("visibilitychange"));
  });
  await until("asked again", () => asked().includes("world/camera"));
});

test("without manual drive in the graph there is no switch", async () => {
  await open({ drive: false });
  assert.ok(!(await page.locator(".drive-switch").isVisible()));
});

test("without a pose the path is dead reckoning, and says so", async () => {
  await open({ vehicle: false });
  await until("the word", async () => (await text("#vehicle .panel-note")) === "dead reckoning");
  await until("fresh", async () => !(await page.locator("#vehicle").evaluate((each) => each.classList.contains("is-stale"))));
});

test("parameters can be found by name, and an input from outside can be fed", async () => {
  await open();
  await page.locator('[data-node="decision"]').click();
  await page.getByLabel("Find a parameter").fill("k_ang");
  assert.equal(await page.locator(".parameters .parameter:visible").count(), 1);
  await page.getByLabel("Value for goal").fill('{"cruise": {"speed_m_s": 0.4}}');
  await page.getByLabel("Value for goal").press("Enter");
  await until("the goal", () => of("pub").length === 1);
  assert.deepEqual([of("pub")[0].key, of("pub")[0].value], ["decision/goal", { cruise: { speed_m_s: 0.4 } }]);
});

test("a collapsed panel asks for nothing, also after a reload", async () => {
  await open();
  await until("asked", () => asked().includes("world/scan"));
  await page.getByRole("button", { name: "Hide Lidar" }).click();
  await until("given up", () => !asked().includes("world/scan"));
  await page.reload();
  await page.getByRole("button", { name: "Show Lidar" }).click();
  await until("asked again", () => asked().includes("world/scan"));
});

test("the log keeps its place while somebody reads", async () => {
  await open();
  for (let line = 0; line < 120; line++) mock.log("info", "lane", `line ${line}`);
  const list = page.locator(".log-list");
  await until("the last line", async () => (await list.textContent()).includes("line 119"));
  await until("at the end", () => list.evaluate((each) => each.scrollTop + each.clientHeight >= each.scrollHeight - 8));
  await list.evaluate((each) => { each.scrollTop = 40; });
  await until("the button", () => page.locator(".log-end").isVisible());
  mock.log("info", "lane", "one more");
  await until("it came", async () => (await list.textContent()).includes("one more"));
  assert.equal(await list.evaluate((each) => each.scrollTop), 40);
  await page.getByLabel("Filter text").fill("one more");
  await until("filtered", async () => (await page.locator(".log-line").count()) === 1);
});

test("a phone shows the camera and the e-stop without scrolling, and nothing sticks out", async () => {
  await open({}, { size: { width: 390, height: 844 }, phone: true });
  await until("a frame", () => of("ack").length > 0);
  const inView = (selector) => page.locator(selector).evaluate((each) => { const box = each.getBoundingClientRect(); return box.top >= 0 && box.bottom <= window.innerHeight && box.left >= 0 && box.right <= window.innerWidth; });
  assert.ok(await inView(".camera-canvas"));
  assert.ok(await inView("#estop"));
  assert.equal(await page.evaluate(() => document.documentElement.scrollWidth), 390);
  await page.evaluate(() => window.scrollTo(0, document.body.scrollHeight));
  assert.ok(await inView("#estop"), "wherever one scrolls");
  await until("images that nobody sees are given up", () => !asked().includes("world/camera"));
  await page.locator("#estop").tap();
  await until("e-stop", () => of("control").some((each) => each.word === "estop"));
});

test("the graph can be made large, and small again", async () => {
  await open();
  const tall = () => page.locator("#graph").evaluate((each) => each.clientHeight);
  const before = await tall();
  await page.getByRole("button", { name: "Large graph" }).click();
  assert.ok((await tall()) > before * 2);
  await page.getByRole("button", { name: "Large graph" }).click();
  assert.equal(await tall(), before);
});

test("a laptop shows every panel without scrolling", async () => {
  await open();
  assert.deepEqual(await page.evaluate(() => [document.documentElement.scrollWidth, document.documentElement.scrollHeight]), [1280, 800]);
});

test("keys are listed, colours are remembered", async () => {
  await open();
  await page.keyboard.press("?");
  assert.ok(await page.getByRole("dialog", { name: "Keys" }).isVisible());
  await page.keyboard.press("Escape");
  const look = page.getByRole("button", { name: /^Colours/ });
  await look.click();
  await look.click();
  assert.equal(await page.evaluate(() => document.documentElement.dataset.theme), "dark");
  await page.reload();
  assert.equal(await page.evaluate(() => document.documentElement.dataset.theme), "dark");
});
