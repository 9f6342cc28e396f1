// Puts the page together.
import "./app.css";
import { banner } from "./banner";
import { Car } from "./car";
import { watchControl } from "./control";
import { h } from "./dom";
import { keyHelp, startKeys } from "./keys";
import { startNotices } from "./notices";
import { cameraPanel } from "./panels/camera";
import { logPanel } from "./panels/log";
import { Subscriptions } from "./subscriptions";
import { startTheme } from "./theme";
import { topbar } from "./topbar";

const REFRESH_MS = 200;
const PING_MS = 1000;

startTheme();
const car = new Car(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/ws`);
const subscriptions = new Subscriptions(car);
watchControl(car);
const notices = startNotices((tone, text) => car.emit("note", { level: tone === "bad" ? "error" : tone === "warn" ? "warning" : "info", text }));
const help = keyHelp();
const bar = topbar(car, subscriptions, () => help.showModal());
const faults = banner(car);
const camera = cameraPanel(car, subscriptions);
const log = logPanel(car);
const panels = [camera, log.panel];
const app = document.getElementById("app") ?? document.body;
app.append(bar.root, faults.root, h("main", { class: "desk" }, camera.root, log.panel.root), notices, help);
startKeys(car, help);

window.setInterval(() => {
  bar.refresh();
  faults.refresh();
  for (const panel of panels) panel.refresh();
}, REFRESH_MS);
window.setInterval(() => car.connection.tick(), PING_MS);
bar.refresh();
car.connection.open();
