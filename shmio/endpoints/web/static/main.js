// The page: head line, tabs, theme and session.

import { CellsTab } from "./cells.js";
import { ConfigurationTab } from "./configuration.js";
import { Connection } from "./connection.js";
import { byId, element, replace, setText } from "./dom.js";
import { duration } from "./format.js";
import { InjectionsTab } from "./injections.js";
import { LogTab } from "./log.js";
import { OverviewTab } from "./overview.js";
import { PlotsTab, plot } from "./plots.js";
import { RecordingsTab } from "./recordings.js";
import { RegistersTab } from "./registers.js";
import { SceneTab } from "./scene/tab.js";
import { session, signIn, signOut } from "./session.js";
import { TimeTab } from "./time.js";

/**
 * @typedef {{ root: HTMLElement, close: () => void, resume?: () => void }} Tab A tab that is shown. `resume` requests again
 *   what the tab follows, after the connection was lost.
 * @typedef {{ connection: Connection, overview: any, may: (role: string) => boolean, show: (name: string) => void }} Context
 */

/** @type {Record<string, { title: string, make: (context: Context) => Tab }>} */
const TABS = {
  overview: { title: "Overview", make: (context) => new OverviewTab(context) },
  cells: { title: "Cells", make: (context) => new CellsTab(context) },
  registers: { title: "Registers", make: (context) => new RegistersTab(context) },
  plots: { title: "Plots", make: (context) => new PlotsTab(context) },
  scene: { title: "3D", make: (context) => new SceneTab(context) },
  injections: { title: "Injections", make: (context) => new InjectionsTab(context) },
  time: { title: "Time", make: (context) => new TimeTab(context) },
  recordings: { title: "Recordings", make: (context) => new RecordingsTab(context) },
  configuration: { title: "Configuration", make: (context) => new ConfigurationTab(context) },
  log: { title: "Log", make: (context) => new LogTab(context) },
};

const connection = new Connection();
/** @type {import("./session.js").Session} */
let user = { instance: "", name: "", roles: [], takes_tokens: false, tabs: [] };
/** @type {Tab | null} */
let shown = null;
let shownName = "";
/** @type {Context} */
const context = { connection, overview: null, may: (role) => user.roles.includes(role), show: (name) => (location.hash = name) };

function showTab() {
  const wanted = location.hash.slice(1).split("/")[0];
  const name = wanted in TABS && user.tabs.includes(wanted) ? wanted : "overview";
  shown?.close();
  shown = TABS[name].make(context);
  shownName = name;
  replace(byId("main"), shown.root);
  if (connection.open) shown.resume?.();
  for (const button of byId("tabs").children) {
    const selected = button.id === `tab-${name}`;
    button.setAttribute("aria-selected", String(selected));
    button.setAttribute("tabindex", selected ? "0" : "-1");
  }
}

function makeTabs() {
  const buttons = Object.entries(TABS).map(([name, { title }]) =>
    element("button", { type: "button", role: "tab", id: `tab-${name}`, hidden: true, click: () => context.show(name) }, title),
  );
  byId("tabs").replaceChildren(...buttons);
  byId("tab-plots").addEventListener("dragover", (event) => event.preventDefault());
  byId("tab-plots").addEventListener("drop", (event) => {
    event.preventDefault();
    const path = event.dataTransfer?.getData("text/plain");
    if (path) plot(path);
  });
  byId("tabs").addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    const present = buttons.filter((button) => !button.hidden);
    const at = present.findIndex((button) => button === document.activeElement);
    if (step === undefined || at < 0) return;
    const next = present[(at + step + present.length) % present.length];
    next.focus();
    next.click();
  });
}

/** @param {any} overview */
function showHead(overview) {
  context.overview = overview;
  setText(byId("instance"), overview.instance);
  document.title = `${overview.instance} – shmio`;
  const state = byId("state");
  setText(state, overview.state);
  state.className = `badge ${overview.state}`;
  const { clock } = overview;
  const time = clock.mode === "wall" ? `real time, since ${duration(clock.time_s)}` : `virtual time ${clock.time_s.toFixed(3)} s`;
  const step = clock.mode === "virtual" ? `, step ${clock.step}${clock.playing ? `, ${clock.rate} times real time` : ""}` : "";
  setText(byId("clock"), `mode ${overview.mode}, ${time}${step}`);
  setText(byId("note"), overview.note);
}

/** @param {import("./session.js").Session} found */
function showUser(found) {
  user = found;
  for (const name of Object.keys(TABS)) byId(`tab-${name}`).hidden = !found.tabs.includes(name);
  setText(byId("instance"), user.instance);
  const roles = user.roles.join(", ") || "no role";
  const act = user.name
    ? element("button", { type: "button", click: async () => enter(await signOut()) }, "Sign out")
    : element("button", { type: "button", click: askToken }, "Sign in");
  replace(byId("user"), `${user.name || "no token"} (${roles}) `, user.takes_tokens || user.name ? act : null);
}

async function askToken() {
  const found = await signIn();
  if (found !== null) enter(found);
}

/** @param {import("./session.js").Session} found */
function enter(found) {
  showUser(found);
  connection.close();
  shown?.close();
  shown = null; // the next connection shows the tab with the new roles
  if (context.may("read")) {
    connection.connect();
    return;
  }
  byId("offline").hidden = true;
  replace(byId("main"), element("p", {}, "Sign in to see this cell."));
}

function makeTheme() {
  const root = document.documentElement;
  root.dataset.theme = localStorage.getItem("theme") ?? "";
  byId("theme").addEventListener("click", () => {
    const dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
    root.dataset.theme = dark ? "light" : "dark";
    localStorage.setItem("theme", root.dataset.theme);
  });
}

connection.follow("overview", showHead);
connection.addEventListener("open", async () => {
  byId("offline").hidden = true;
  const before = user.roles.join();
  showUser(await session().catch(() => user)); // a restart may have brought other tabs and roles
  connection.call("overview.follow").catch(() => {});
  if (shown === null || !user.tabs.includes(shownName) || before !== user.roles.join()) showTab();
  else shown.resume?.();
});
connection.addEventListener("lost", async () => {
  byId("offline").hidden = false;
  const found = await session().catch(() => null); // the session may have ended
  if (found !== null && !found.roles.includes("read")) enter(found);
});
window.addEventListener("hashchange", showTab);
makeTheme();
makeTabs();
enter(await session());
if (!context.may("read") && user.takes_tokens) askToken();
