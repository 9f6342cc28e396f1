// The built page in a real browser, on the real server, with the simulated car behind it. Started by tests/dashboard_page.rs, which has the
// car: lines of JSON go to it, lines come back.
//
//   PAGE=http://127.0.0.1:PORT/ READER=http://127.0.0.1:PORT/ [THOROUGH=yes] [SHOTS=folder] node tests-live/car.mjs
import assert from "node:assert/strict";
import { existsSync } from "node:fs";
import { createInterface } from "node:readline";
import { chromium } from "playwright-core";

const { PAGE, READER, SHOTS, THOROUGH } = process.env;
const executablePath = [process.env.CHROMIUM, "/usr/bin/chromium", "/usr/bin/chromium-browser", "/usr/bin/google-chrome"].find((path) => path && existsSync(path));
const ARGS = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync"];
const PATIENCE_MS = 120_000; // only a hang fails
/** So many different frames must have been shown before their rate is told. */
const FRAMES = 90;
const SOAK_MS = 60_000;

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
  await page.addInitScript(countFrames);
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

/** Counts in the page what it paints: different pictures that came from the car, by what is in them. Runs before the page's own code. */
function countFrames() {
  const small = new OffscreenCanvas(32, 24).getContext("2d", { willReadFrequently: true });
  const [known, seen] = [new WeakSet(), new Set()];
  window.frames_shown = { different: 0, last: "" };
  const paint = CanvasRenderingContext2D.prototype.drawImage;
  CanvasRenderingContext2D.prototype.drawImage = function (image, ...rest) {
    paint.call(this, image, ...rest);
    if (!(image instanceof ImageBitmap) || !this.canvas.classList.contains("camera-canvas") || known.has(image)) return;
    known.add(image);
    small.drawImage(image, 0, 0, 32, 24);
    const content = small.getImageData(0, 0, 32, 24).data.join();
    if (content !== window.frames_shown.last) window.frames_shown.different += 1;
    window.frames_shown.last = content;
  };
}

/** How many different frames a second are on the screen: told, not judged. That they come and differ is. */
async function tellFrameRate(page) {
  const shown = () => page.evaluate(() => [window.frames_shown.different, performance.now()]);
  const [before, began_ms] = await shown();
  let [after, ended_ms] = [before, began_ms];
  await until(`${FRAMES} different frames on the screen`, async () => {
    [after, ended_ms] = await shown();
    return after >= before + FRAMES;
  });
  const seconds = (ended_ms - began_ms) / 1000;
  console.error(`frames shown: ${((after - before) / seconds).toFixed(1)} a second, ${after - before} different ones in ${seconds.toFixed(1)} s`);
}

/** What lives on the heap of the page after everything that is not needed has been thrown away, B. */
async function heapOf(page) {
  const session = await page.context().newCDPSession(page);
  await session.send("HeapProfiler.enable");
  for (let turn = 0; turn < 3; turn++) await session.send("HeapProfiler.collectGarbage");
  const { usedSize } = await session.send("Runtime.getHeapUsage");
  await session.detach();
  return usedSize;
}

/** Everything that the page keeps is bounded: a minute of plots and path, the last lines of the log. */
async function soak(page) {
  await page.waitForTimeout(SOAK_MS); // until what is kept for a minute is full
  const [before, shown] = [await heapOf(page), await page.evaluate(() => window.frames_shown.different)];
  await page.waitForTimeout(SOAK_MS);
  const [after, more] = [await heapOf(page), (await page.evaluate(() => window.frames_shown.different)) - shown];
  console.error(`heap of the page: ${(before / 1e6).toFixed(1)} MB, and ${(after / 1e6).toFixed(1)} MB after ${more} more frames`);
  assert.ok(more > FRAMES, `it was at work: ${more} frames`);
  assert.ok(after < 1.5 * before + 4e6, `the heap grows: ${before} B, then ${after} B`);
}

/** Whether an element is on the screen, all of it. */
const inView = (page, selector) => page.locator(selector).evaluate((each) => {
  const box = each.getBoundingClientRect();
  return box.width > 0 && box.top >= 0 && box.bottom <= window.innerHeight && box.left >= 0 && box.right <= window.innerWidth;
});

/** A phone: nothing sticks out to the side, and the e-stop is always there. */
async function lookOnPhone() {
  const page = await open(PAGE, { phone: true, size: { width: 390, height: 844 } });
  const first = await picture(page);
  await until("the camera on a phone", async () => (await picture(page)) !== first);
  const fits = async (what) => {
    assert.equal(await page.evaluate(() => Math.max(document.documentElement.scrollWidth, document.body.scrollWidth)), 390, `${what}: nothing sticks out`);
    assert.ok(await inView(page, "#estop"), `${what}: the e-stop is on the screen`);
  };
  await fits("at the top");
  await page.evaluate(() => window.scrollTo(0, document.body.scrollHeight));
  await fits("at the end");
  await page.locator('[data-node="lane"]').click();
  await page.locator(".details").waitFor();
  await fits("with the details of a node");
  await page.getByRole("button", { name: "Swap…" }).click();
  await fits("with the swap form");
  await page.locator("#estop").tap();
  await until("the phone stops the car", async () => (await please({ ask: "state" })).value === "e-stop");
  await page.context().close();
}

/** As a person does: a stop that the microcontroller reports late, on a busy machine, stops the car once more after a reset. */
async function driveAgain(page) {
  const press = (name) => page.getByRole("button", { name, exact: true }).first().click();
  const figures = async () => JSON.stringify([await text(page, "#state"), await text(page, ".state-reason"), await text(page, ".banner-text"), (await page.locator(".log-text").allTextContents()).slice(-8)]);
  let tries = 0;
  await until("it drives again", async () => {
    const state = await text(page, "#state");
    if (state === "lane-follow") return true;
    if (!/[a-z]/.test(state ?? "")) return false; // the page has not heard of it yet
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
  await driveAgain(page); // on a busy machine it may have stopped since it was launched
  const first = await picture(page);
  await until("another picture", async () => (await picture(page)) !== first);
  await until("age of the command", async () => /^\d+$/.test(await text(page, "#top-age")));
  await until("nothing is stale", async () => (await page.locator(".panel.is-stale").count()) === 0);
  const labels = () => page.locator(".edge-label").allTextContents();
  await until("rates and bandwidths along the edges", async () => (await labels()).some((label) => /^\d+ MB\/s$/.test(label)) && (await labels()).filter((label) => /^[\d.]+ Hz$/.test(label)).length >= 6);
  await tellFrameRate(page);

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

  await page.getByRole("button", { name: "Swap…" }).click();
  await page.getByLabel("Changed values").fill('{"threshold": 165}');
  const version = async () => Number(/version (\d+)/.exec(await text(page, ".details-sub"))?.[1]);
  const before_swap = await version();
  await page.getByRole("button", { name: "Swap", exact: true }).click();
  await until("the new version runs", async () => (await please({ ask: "threshold" })).value === "165" && (await version()) > before_swap);
  await until("the log has its receipt", () => said(page, /swap done/));
  assert.ok(await page.locator(".swap").isHidden(), "the form has done its work");
  const swapped = await picture(page);
  await until("the car goes on", async () => (await picture(page)) !== swapped);
  await page.locator('[data-node="mcu"]').click();
  assert.deepEqual(await page.getByLabel("Operator").locator("option").allTextContents(), ["sim-mcu, as now", "sim-avr"], "what fits is offered");
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
  if (THOROUGH) await soak(page);
  await lookOnPhone();
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
