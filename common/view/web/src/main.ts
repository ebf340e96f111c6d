// Ties the modules together: state.ts (what a link holds), network.ts (what is asked), drawing/ (what is seen),
// asking.ts (questions), pointing.ts (pointer and keys).

import "./style.css";
import type { Viewpoint } from "./answers";
import { Asking } from "./asking";
import { ChangesPanel } from "./changes";
import { Dropping } from "./dropping";
import { Drawing } from "./drawing/drawing";
import { type Description, describe, fetchWords, follow, NotFound, setToken, Unauthorized, type Word } from "./network";
import { askToken, covered, note, paintRamp, panel, say, showBeside, showFacts } from "./panel";
import { forgetPictures } from "./photos";
import { PlacesToStand } from "./places";
import { Pointing } from "./pointing";
import { Robot } from "./robot";
import { readHistory, readState, writeState } from "./state";
import { Streaming } from "./streaming";
import { Combobox, showChips, suggest } from "./suggestions";
import { followTheme, themeNow } from "./theme";

const PAUSE_IN_TYPING_MS = 150;
const LOOK_EVERY_MS = 4000;

const state = readState();
const robot = new Robot();
let description: Description;
let drawing: Drawing;
let streaming: Streaming;
let asking: Asking;
let changes: ChangesPanel;
let typing = 0;
let looking = 0;
/** Of the generation that is drawn, and whether they are all. */
let words: Word[] = [];
let hasAllWords = false;
const comboboxes: Combobox[] = [];

/** Runs a request again after the token was given. */
async function withToken<T>(request: () => Promise<T>): Promise<T> {
  for (;;) {
    try {
      return await request();
    } catch (error) {
      if (!(error instanceof Unauthorized)) throw error;
      setToken(await askToken());
    }
  }
}

function report(error: unknown, tell = note): void {
  if (error instanceof Unauthorized) {
    void withToken(describe).then(() => asking.ask());
    return;
  }
  tell(error instanceof Error ? error.message : String(error), true);
}

/** Distances are from the robot, or where none is from the camera. */
function viewpoint(ofCamera = false): Viewpoint {
  const { position_m, geographic } = description;
  if (position_m && !ofCamera) return { at: position_m, from: "the robot", headingRad: robot.headingRad, isGeographic: geographic };
  const { position, target } = drawing.pose();
  return { at: position, from: "this view", headingRad: Math.atan2(target[1] - position[1], target[0] - position[0]), isGeographic: geographic };
}

function showRobot(isOffline = false): void {
  robot.see(description);
  drawing.showRobot(description, robot.headingRad);
  asking.moved();
  void robot.show(description, isOffline);
}

function open(): void {
  drawing = new Drawing(panel.canvas, panel.labels, description, () => asking.leavePhoto(), () => asking.moved(), (share) => streaming.isComplete && streaming.lower(share), covered);
  const places = new PlacesToStand(drawing);
  asking = new Asking(state, drawing, places, () => description, viewpoint, lookSoon, report);
  changes = new ChangesPanel(drawing, panel.changes);
  new Pointing(drawing, asking, places, () => description);
  new Dropping(drawing, asking, () => description, report);
  panel.locate.hidden = description.program !== "slag-edge";
  panel.form.hidden = !description.can_ask;
  drawing.setTheme(themeNow());
  showRobot();
  restore();
  stream();
  if (description.can_ask && (state.question || state.second)) void askOnceDrawn();
}

/** Shows what the address says, but for answers. */
function restore(): void {
  if (state.camera) drawing.placeAt(state.camera);
  panel.question.value = state.question;
  panel.second.value = state.second;
  showBeside(state.second !== "");
}

/** Groups are made of what is drawn. */
async function askOnceDrawn(): Promise<void> {
  await streaming.whole;
  await asking.ask();
}

/** Learns which words find something; without them, only the history is suggested. */
async function learnWords(): Promise<void> {
  const learnt = description.can_ask ? await fetchWords().catch(() => null) : null;
  words = learnt?.words ?? [];
  // Models that take any text count a few words a request.
  hasAllWords = learnt?.complete ?? true;
  for (const combobox of comboboxes) combobox.refresh();
  showChips(panel.chips, words, (word) => {
    panel.question.value = word;
    read();
  });
  hideChips();
}

/** Chips make room for suggestions and for answers. */
function hideChips(): void {
  const isSuggesting = [panel.questionSuggestions, panel.secondSuggestions].some(({ hidden }) => !hidden);
  panel.chips.hidden = isSuggesting || panel.question.value.trim() !== "" || panel.chips.childElementCount === 0;
}

function stream(): void {
  void learnWords();
  const isOpening = !state.camera && document.documentElement.dataset.gaussians === undefined;
  const facts = () => {
    const { min, max } = drawing.extent.box;
    showFacts(description, drawing.cells.nDrawn, drawing.stepM, [max.x - min.x, max.y - min.y, max.z - min.z]);
  };
  streaming = new Streaming(description, drawing, () => {
    document.documentElement.dataset.firstPictureMs ??= performance.now().toFixed(0);
    document.documentElement.toggleAttribute("data-complete", streaming.isComplete);
    document.documentElement.dataset.gaussians = String(drawing.cells.nDrawn);
    facts();
  }, report);
  void streaming.whole.then(() => {
    document.documentElement.dataset.wholePictureMs ??= performance.now().toFixed(0);
    drawing.measureExtent(isOpening);
    showRobot();
    facts();
  });
  facts();
  streaming.update();
}

const cellsOf = (seen: Description) => JSON.stringify(seen.cells.map(({ cell, state, generation, n_gaussians }) => [cell, state, generation, n_gaussians]));

/** Polls the service for its generation, cells and the robot's place, and notices when it is gone. */
async function look(): Promise<void> {
  try {
    const seen = await describe();
    const isOtherGeneration = seen.generation !== description.generation || seen.scene !== description.scene;
    const isOther = isOtherGeneration || cellsOf(seen) !== cellsOf(description);
    const wasOffline = document.documentElement.dataset.offline !== undefined;
    delete document.documentElement.dataset.offline;
    description = seen;
    showRobot();
    if (isOther) {
      streaming.stop();
      drawing.cells.clear();
      drawing.marks.showCells(seen.cells);
      if (isOtherGeneration) forgetPictures();
      stream();
      if (panel.showChanges.checked) void changes.show();
      if (description.can_ask && (state.question || state.second)) await askOnceDrawn();
      note(isOtherGeneration ? `The service has generation ${seen.generation} now.` : "Other cells are on board now.");
    } else {
      streaming.update();
      if (!hasAllWords) void learnWords();
      if (wasOffline) note("The service is back.");
      if (asking.isCutOff) await asking.ask();
    }
  } catch (error) {
    document.documentElement.dataset.offline = "";
    showRobot(true);
    report(error);
  }
  state.camera = drawing.pose();
  writeState(state);
  lookSoon(LOOK_EVERY_MS);
}

/** Schedules one poll. */
function lookSoon(afterMs = 0): void {
  clearTimeout(looking);
  looking = window.setTimeout(() => void look(), afterMs);
}

/** Listens to a robot's events; without them the next poll finds changes. */
async function hearEvents(): Promise<void> {
  try {
    await follow((name, data) => {
      if (name === "generation" && (data as { generation?: number } | null)?.generation !== description.generation) lookSoon();
      if (name === "following") lookSoon();
    });
  } catch {
    // The page polls every few seconds anyway.
  }
  setTimeout(() => void hearEvents(), 5 * LOOK_EVERY_MS);
}

/** Asks what stands in the boxes. */
function read(): void {
  clearTimeout(typing);
  if (panel.question.value.trim() !== state.question) state.threshold = null;
  [state.question, state.second] = [panel.question.value.trim(), panel.second.value.trim()];
  hideChips();
  void asking.ask();
}

function listenToForm(): void {
  panel.form.addEventListener("submit", (event) => {
    event.preventDefault();
    read();
  });
  for (const [box, list] of [[panel.question, panel.questionSuggestions], [panel.second, panel.secondSuggestions]] as const) {
    comboboxes.push(new Combobox(box, list, (line) => suggest(line, readHistory(), words), read, hideChips));
    box.addEventListener("input", () => {
      clearTimeout(typing);
      typing = window.setTimeout(read, PAUSE_IN_TYPING_MS);
    });
  }
  panel.more.addEventListener("click", () => showBeside(panel.beside.hidden));
  panel.threshold.addEventListener("input", () => asking.light(Number(panel.threshold.value)));
}

function listen(): void {
  listenToForm();
  const toggle = (box: HTMLInputElement, group: () => { visible: boolean }) => box.addEventListener("change", () => {
    group().visible = box.checked;
    drawing.redraw();
  });
  toggle(panel.showBoxes, () => drawing.marks.boxes);
  toggle(panel.showGrid, () => drawing.marks.ground);
  toggle(panel.showCells, () => drawing.marks.cells);
  toggle(panel.showPhotos, () => drawing.marks.photos);
  panel.showChanges.addEventListener("change", () => (panel.showChanges.checked ? void changes.show() : changes.hide()));
  panel.copyLink.addEventListener("click", () => {
    state.camera = drawing.pose();
    writeState(state);
    // Browsers give pages a clipboard over HTTPS and on this machine only.
    const copied = navigator.clipboard?.writeText(location.href) ?? Promise.reject(new Error("no clipboard"));
    copied.then(() => note("The link is copied."), () => note("The browser does not let this page copy; take the link from the address bar."));
  });
  // Back, forward, or a link that was pasted.
  addEventListener("popstate", () => {
    clearTimeout(typing);
    Object.assign(state, readState());
    restore();
    hideChips();
    if (description.can_ask) void asking.ask();
  });
  panel.sheet.addEventListener("click", () => panel.sheet.setAttribute("aria-label", panel.aside.classList.toggle("large") ? "Smaller panel" : "Larger panel"));
  new ResizeObserver(() => drawing.resize()).observe(panel.aside);
}

async function start(): Promise<void> {
  if (!document.createElement("canvas").getContext("webgl2")) {
    return say("This browser has no WebGL 2, which drawing the scene needs. Switch on hardware acceleration or take another browser.", true);
  }
  say("Opening…");
  try {
    description = await withToken(describe);
  } catch (error) {
    say(error instanceof NotFound ? "This service has no scene to show (it does not answer /v1/view)." : String((error as Error).message), true);
    setTimeout(() => void start(), LOOK_EVERY_MS);
    return;
  }
  say("");
  open();
  listen();
  lookSoon(LOOK_EVERY_MS);
  if (description.program === "slag-edge") void hearEvents();
}

followTheme((theme) => {
  drawing?.setTheme(theme);
  paintRamp();
});
void start();
