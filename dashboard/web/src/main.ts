// Puts the page together.
import "./app.css";
import { banner } from "./banner";
import { Car } from "./car";
import { watchControl } from "./control";
import { h } from "./dom";
import { keyHelp, startKeys } from "./keys";
import { announce, startNotices } from "./notices";
import { cameraPanel } from "./panels/camera";
import { decisionPanel } from "./panels/decision";
import { detailsDrawer } from "./panels/details";
import { drivePanel } from "./panels/drive";
import { graphPanel } from "./panels/graph";
import { lidarPanel } from "./panels/lidar";
import { logPanel } from "./panels/log";
import { plotsPanel } from "./panels/plots";
import { vehiclePanel } from "./panels/vehicle";
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
const log = logPanel(car).panel;
const [camera, lidar, vehicle] = [cameraPanel(car, subscriptions), lidarPanel(car, subscriptions), vehiclePanel(car, subscriptions)];
const graphAndMark = graphPanel(car, (node) => details.open(node));
const details = detailsDrawer(car, (node) => graphAndMark.select(node));
const [graph, decision, plots] = [graphAndMark.panel, decisionPanel(car), plotsPanel(car)];
const panels = [camera, lidar, vehicle, graph, decision, plots, log];

const app = document.getElementById("app") ?? document.body;
app.append(bar.root, faults.root,
  h("main", { class: "desk" },
    h("div", { class: "column column-camera" }, camera.root, drivePanel(car)),
    h("div", { class: "column column-around" }, lidar.root, vehicle.root),
    graph.root,
    h("div", { class: "column column-side" }, decision.root, plots.root, log.root),
    details.root),
  notices, help);
startKeys(car, help);

let wasConnected = false;
let everConnected = false;
car.on("connection", () => {
  const connected = car.connection.connected;
  if (connected === wasConnected) return;
  wasConnected = connected;
  if (!connected) car.emit("note", { level: "error", text: `connection lost${car.goodbye ? `: ${car.goodbye}` : ""}` });
  else if (everConnected) announce("good", "Connected again");
  everConnected ||= connected;
});

function refresh(): void {
  bar.refresh();
  faults.refresh();
  for (const panel of panels) panel.refresh();
}
window.setInterval(refresh, REFRESH_MS);
window.setInterval(() => car.connection.tick(), PING_MS);
refresh();
car.connection.open();
