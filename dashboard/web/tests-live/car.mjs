// The built page in a real browser, on the real server, with the simulated car behind it. Started by tests/dashboard_page.rs, which has the
// car: lines of JSON go to it, lines come back.
//
//   PAGE=http://127.0.0.1:PORT/ READER=http://127.0.0.1:PORT/ [SHOTS=folder] node tests-live/car.mjs
import assert from "node:assert/strict";
import { existsSync } from "node:fs";
import { createInterface } from "node:readline";
import { chromium } from "playwright-core";

const { PAGE, READER, SHOTS } = process.env;
const executablePath = [process.env.CHROMIUM, "/usr/bin/chromium", "/usr/bin/chromium-browser", "/usr/bin/google-chrome"].find((path) => path && existsSync(path));
const ARGS = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync"];
const PATIENCE_MS = 60_000; // only a hang fails

const lines = createInterface({ input: process.stdin })[Symbol.asyncIterator]();
/** Has the test do something, and waits for its answer. */
async function please(what) {
  console.log(JSON.stringify(what));
  const { value, done } = await lines.next();
  assert.ok(!done, `the test has gone while asked for ${JSON.stringify(what)}`);
  return JSON.parse(value);
}

async function until(what, condition) {
  const giveUp = Date.now() + PATIENCE_MS;
  while (!(await condition())) {
    assert.ok(Date.now() < giveUp, `never came: ${what}`);
    await new Promise((done) => setTimeout(done, 50));
  }
}

const browser = await chromium.launch({ executablePath, args: ARGS });
const complaints = [];

async function open(url, { expected = [], size = { width: 1280, height: 800 }, phone = false, dark = false } = {}) {
  const context = await browser.newContext({ viewport: size, hasTouch: phone, isMobile: phone, colorScheme: dark ? "dark" : "light" });
  const page = await context.newPage();
  page.setDefaultTimeout(PATIENCE_MS);
  page.on("console", (message) => {
    if (["error", "warning"].includes(message.type()) && !expected.some((each) => each.test(message.text()))) complaints.push(message.text());
  });
  page.on("pageerror", (error) => complaints.push(String(error)));
  page.on("request", (request) => {
    if (!request.url().startsWith(url) && !request.url().startsWith("blob:")) complaints.push(`request to ${request.url()}`);
  });
  await page.goto(url);
  await page.locator(".link-state", { hasText: "connected" }).waitFor();
  return page;
}

const text = (page, selector) => page.locator(selector).first().textContent();
const picture = (page) => page.locator(".camera-canvas").evaluate((canvas) => canvas.toDataURL());
const said = async (page, pattern) => (await page.locator(".log-text").allTextContents()).some((line) => pattern.test(line));

/** As a person does: a stop that the microcontroller reports late, on a busy machine, stops the car once more after a reset. */
async function driveAgain(page) {
  const press = (name) => page.getByRole("button", { name, exact: true }).first().click();
  const figures = async () => JSON.stringify([await text(page, "#state"), await text(page, ".state-reason"), await text(page, ".banner-text"), (await page.locator(".log-text").allTextContents()).slice(-8)]);
  let tries = 0;
  await until("it drives again", async () => {
    const state = await text(page, "#state");
    if (state === "lane-follow") return true;
    if (tries++ > 0) console.error(`not yet: ${await figures()}`);
    await press(state === "idle" ? "Start" : "Reset");
    await page.waitForTimeout(1000);
    return false;
  });
}

async function shoot(name, options) {
  if (!SHOTS) return;
  const page = await open(PAGE, options);
  await until("fresh", async () => (await page.locator(".panel.is-stale").count()) === 0);
  await page.waitForTimeout(6000); // plots and paths grow
  await page.screenshot({ path: `${SHOTS}/${name}.png` });
  await options.then?.(page);
  await page.context().close();
}

try {
  const page = await open(PAGE, { expected: [/WebSocket|ERR_CONNECTION|503/] });

  assert.equal(await text(page, ".robot"), "car1");
  await until("it drives", async () => (await text(page, "#state")) === "lane-follow");
  const first = await picture(page);
  await until("another picture", async () => (await picture(page)) !== first);
  await until("age of the command", async () => /^\d+$/.test(await text(page, "#top-age")));
  await until("nothing is stale", async () => (await page.locator(".panel.is-stale").count()) === 0);
  await until("rates along the edges", async () => (await page.locator(".edge-label").allTextContents()).some((label) => /\d/.test(label)));

  const box = await page.locator(".camera-canvas").boundingBox();
  await page.mouse.move(box.x + box.width / 2, box.y + box.height * 0.9);
  await until("the pixel", async () => /x \d+ y \d+ +grey \d+ +rgb \d+ \d+ \d+ +hsv \d+ \d+ \d+/.test(await text(page, "#pixel")));
  await page.mouse.move(box.x - 5, box.y);

  await page.getByRole("button", { name: "mask" }).click();
  await until("the mask is made", async () => (await please({ ask: "listening" })).keys >= 1 && !(await page.locator("#camera").evaluate((each) => each.classList.contains("is-stale"))));
  await page.getByRole("button", { name: "mask" }).click();

  await page.locator('[data-node="lane"]').click();
  const parameter = page.locator('[data-path="threshold"]');
  await parameter.locator(".parameter-number").fill("175");
  await page.keyboard.press("Enter");
  await until("done", async () => (await parameter.locator(".parameter-state").textContent()) === "✓");
  assert.equal((await please({ ask: "threshold" })).value, "175", "the running car has it");
  await parameter.locator('input[type="range"]').focus();
  await page.keyboard.press("ArrowLeft");
  await until("the slider's value is in force", async () => {
    const shown = await parameter.locator(".parameter-number").inputValue();
    return shown !== "175" && (await please({ ask: "threshold" })).value === shown;
  });
  await until("the log names it", () => said(page, /somebody at 127\.0\.0\.1: set lane threshold/));
  await page.keyboard.press("Escape");

  const reader = await open(READER);
  assert.match(await text(reader, ".access-badge"), /read only/);
  const shown = await picture(reader);
  await until("a reader sees", async () => (await picture(reader)) !== shown);
  for (const name of ["Start", "Stop", "Reset"]) assert.ok(await reader.getByRole("button", { name, exact: true }).first().isDisabled(), name);
  await reader.locator("#estop").click();
  await until("the car stands", async () => (await please({ ask: "state" })).value === "e-stop" && (await text(page, "#state")) === "e-stop");
  await reader.context().close();
  await driveAgain(page);

  await please({ ask: "end the server" });
  await until("the page says so", async () => /reconnecting/.test(await text(page, ".link-state")) && /the server has ended/.test(await text(page, ".banner-text")));
  await please({ ask: "start the server" });
  await until("it is back", async () => (await page.locator(".panel.is-stale").count()) === 0 && /connected/.test(await text(page, ".link-state")));
  const before = await picture(page);
  await until("pictures come", async () => (await picture(page)) !== before);

  await page.locator("#estop").click();
  await until("e-stop", async () => (await please({ ask: "state" })).value === "e-stop");
  await driveAgain(page);
  await page.context().close();

  await shoot("light", {});
  await shoot("dark", { dark: true });
  await shoot("details", { then: async (each) => {
    await each.locator('[data-node="lane"]').click();
    await each.waitForTimeout(1500);
    await each.screenshot({ path: `${SHOTS}/details-open.png` });
  } });
  await shoot("phone", { phone: true, size: { width: 390, height: 844 }, then: async (each) => {
    await each.screenshot({ path: `${SHOTS}/phone-all.png`, fullPage: true });
  } });
  assert.deepEqual(complaints, [], "the console is silent: no errors, no violation of the content security policy");
  console.log(JSON.stringify({ ask: "done" }));
} finally {
  await browser.close();
}
process.exit(0);
