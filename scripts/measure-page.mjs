// Measures the page in Chromium: time to the first picture, time of a question and its parts, frames a second
// while the camera turns.
// usage: node scripts/measure-page.mjs OUT.png CAMERA QUESTION,QUESTION PROGRAM FLAGS...
//   OUT.png             picture of the first question's answer, or `none`
//   CAMERA              X,Y,Z,X,Y,Z: position and target, or `whole`
//   PROGRAM FLAGS...    slag-encoder view .. or slag-edge serve .., with a free port, built with the page; from SLAG_PROGRAMS [default: target/debug]
// N_ASKED and TURN_MS: questions, and milliseconds of turning. Prints one JSON object; its `renderer` names the
// GPU, in software SwiftShader unless CHROMIUM_GPU has Chromium's flags for another.

import { execFileSync } from "node:child_process";
import { mkdirSync } from "node:fs";
import { cpus, hostname, loadavg } from "node:os";
import { dirname } from "node:path";
import { closeBrowser, openBrowser, opened, picture } from "../tests/page/browser.mjs";
import { serve } from "../tests/page/programs.mjs";

const [out, camera, questionsIn, program, ...flags] = process.argv.slice(2);
const questions = questionsIn.split(",").filter(Boolean);
const N_ASKED = Number(process.env.N_ASKED ?? 7);
const TURN_MS = Number(process.env.TURN_MS ?? 20000);
const WAIT = { timeout: 600000 };

/** Runs in the page before its scripts: looks at every frame what is drawn, and times the renderer's sorting. */
function watchFrames() {
  const getContext = HTMLCanvasElement.prototype.getContext;
  HTMLCanvasElement.prototype.getContext = function (kind, options, ...rest) {
    return getContext.call(this, kind, kind === "webgl2" ? { ...options, preserveDrawingBuffer: true } : options, ...rest);
  };
  const watched = (window.watched = { firstPictureMs: null, changes: [], drawn: [], sorts: [] });
  const draw = WebGL2RenderingContext.prototype.drawElementsInstanced;
  WebGL2RenderingContext.prototype.drawElementsInstanced = function (...args) {
    watched.drawn.push(performance.now());
    return draw.apply(this, args);
  };
  const post = Worker.prototype.postMessage;
  Worker.prototype.postMessage = function (message, ...rest) {
    if (message?.name === "sortSplats32") {
      const start = performance.now();
      const hear = ({ data }) => {
        if (data.id !== message.id) return;
        this.removeEventListener("message", hear);
        watched.sorts.push(performance.now() - start);
      };
      this.addEventListener("message", hear);
    }
    return post.call(this, message, ...rest);
  };
  const [width, height] = [110, 64];
  let before = "";
  let nSeen = 0;
  const look = (context) => {
    requestAnimationFrame(() => look(context));
    const canvas = document.getElementById("canvas");
    // Reading a picture back waits for it: each is read once.
    if (!canvas || window.isUnwatched || watched.drawn.length === nSeen) return;
    nSeen = watched.drawn.length;
    context.fillStyle = "#000008";
    context.fillRect(0, 0, width, height);
    context.drawImage(canvas, 0, 0, width, height);
    const { data } = context.getImageData(0, 0, width, height);
    let [nDrawn, sum] = [0, 0];
    for (let i = 0; i < data.length; i += 4) {
      // Grid and background are bluish and darker.
      if (data[i] >= data[i + 2] || Math.max(data[i], data[i + 1], data[i + 2]) > 110) nDrawn++;
      sum = (sum * 31 + data[i] + 7 * data[i + 1] + 13 * data[i + 2]) % 1000003;
    }
    if (nDrawn > (width * height) / 200) watched.firstPictureMs ??= performance.now();
    if (String(sum) !== before) watched.changes.push(performance.now());
    before = String(sum);
  };
  const context = new OffscreenCanvas(width, height).getContext("2d", { willReadFrequently: true });
  requestAnimationFrame(() => look(context));
}

/** Waits until nothing is drawn any more. */
const quiet = (page) => page.waitForFunction(() => performance.now() - (window.watched.drawn.at(-1) ?? Infinity) > 1500, null, WAIT);

const median = (values) => [...values].sort((a, b) => a - b)[Math.floor(values.length / 2)] ?? null;
const rounded = (value) => (value === null || value === undefined ? null : Math.round(value * 10) / 10);
const spread = (values) => ({ median: rounded(median(values)), worst: rounded(Math.max(...values)), n: values.length });

const service = await serve(program, flags);
await openBrowser();
const result = { machine: `${hostname()}, ${cpus().length} x ${cpus()[0].model}`, program: execFileSync("git", ["rev-parse", "--short", "HEAD"]).toString().trim(), load_before: loadavg().map(rounded) };
try {
  await opened("about:blank", async (page) => {
    page.setDefaultTimeout(WAIT.timeout);
    await page.addInitScript(watchFrames);
    await page.goto(`${service.url}/view${camera === "whole" ? "" : `#camera=${camera}`}`);
    await page.waitForFunction(() => document.documentElement.dataset.complete !== undefined && window.watched.firstPictureMs !== null, null, WAIT);
    Object.assign(result, await page.evaluate(() => {
      const gl = document.createElement("canvas").getContext("webgl2");
      const { firstPictureMs, wholePictureMs, gaussians } = document.documentElement.dataset;
      const cells = performance.getEntriesByType("resource").filter(({ name }) => name.includes("/v1/view/cells/"));
      return {
        renderer: gl.getParameter(gl.getExtension("WEBGL_debug_renderer_info")?.UNMASKED_RENDERER_WEBGL ?? gl.RENDERER),
        facts: document.getElementById("amount").textContent,
        first_picture_on_screen_ms: Math.round(window.watched.firstPictureMs),
        first_cell_ms: Number(firstPictureMs), whole_scene_ms: Number(wholePictureMs), all_fetched_ms: Math.round(performance.now()),
        drawn_gaussians: Number(gaussians), n_cells_fetched: cells.length, bytes_of_cells: cells.reduce((sum, { encodedBodySize }) => sum + encodedBodySize, 0),
      };
    }));
    await quiet(page);

    if (questions.length > 0) {
      const asked = [];
      for (let i = 0; i < N_ASKED; i++) {
        const question = questions[i % questions.length];
        await page.evaluate(() => performance.clearResourceTimings());
        await page.fill("#question", question);
        await page.waitForFunction((n) => performance.getEntriesByName("answered").length > n, i, WAIT);
        await quiet(page);
        asked.push(await page.evaluate(() => {
          const { startTime, duration } = performance.getEntriesByName("answered").at(-1);
          const of = (path) => performance.getEntriesByType("resource").find(({ name }) => new URL(name).pathname === path);
          const ms = (entry) => ({ server: entry.responseStart - entry.requestStart, whole: entry.responseEnd - startTime });
          const [scores, answers] = [of("/v1/view/scores"), of("/v1/query")];
          const replied = Math.max(ms(scores).whole, ms(answers).whole);
          const lit = window.watched.changes.find((at) => at > startTime + replied);
          return { answered: duration, scores: ms(scores), answers: ms(answers), replied, bytes: scores.encodedBodySize, lit: lit === undefined ? null : lit - startTime };
        }));
      }
      // The first question opens the text model.
      const rest = asked.slice(1);
      const of = (pick) => spread(rest.map(pick).filter((value) => value !== null));
      result.question_ms = {
        since_the_pause: of(({ answered }) => answered), first_of_all: rounded(asked[0].answered), server_scores: of(({ scores }) => scores.server), server_answers: of(({ answers }) => answers.server),
        both_replied: of(({ replied }) => replied), colours_and_frame_given: of(({ answered, replied }) => answered - replied), seen_on_screen: of(({ lit }) => lit),
      };
      result.bytes_of_scores = asked.at(-1).bytes;
    }

    // Frames while the camera turns. What is read back is the watcher's cost.
    await page.evaluate(() => { window.isUnwatched = true; });
    await page.locator("#canvas").focus();
    await page.evaluate(() => { window.watched.drawn = []; window.watched.sorts = []; });
    await page.keyboard.down("ArrowLeft");
    const turn = await page.evaluate((ms) => new Promise((resolve) => setTimeout(() => {
      const { drawn, sorts } = window.watched;
      const end = performance.now();
      const during = (from, to) => drawn.filter((at, i) => at >= from && at < to && (i === 0 || at - drawn[i - 1] > 1)).length / ((to - from) / 1000);
      resolve({ first: during(end - ms, end - ms * 0.8), last: during(end - ms * 0.3, end), sorts, gaussians: Number(document.documentElement.dataset.gaussians) });
    }, ms)), TURN_MS);
    await page.keyboard.up("ArrowLeft");
    result.turning = { frames_a_second_at_first: rounded(turn.first), at_last: rounded(turn.last), gaussians_at_last: turn.gaussians, sort_ms: spread(turn.sorts) };
    result.script_memory_mb = rounded((await page.evaluate(() => performance.memory?.usedJSHeapSize ?? 0)) / 1e6);
  }, { isLookedAt: true, origin: service.url });

  if (out !== "none") {
    await opened(service.url, async (page) => {
      page.setDefaultTimeout(WAIT.timeout);
      await page.waitForFunction(() => document.documentElement.dataset.complete !== undefined, null, WAIT);
      if (questions[0]) await page.waitForFunction((q) => document.documentElement.dataset.answered === q, questions[0], WAIT);
      await picture(page, null);
      mkdirSync(dirname(out), { recursive: true });
      await page.screenshot({ path: out });
    }, { isLookedAt: true, fragment: `${questions[0] ? `q=${encodeURIComponent(questions[0])}` : ""}${camera === "whole" ? "" : `&camera=${camera}`}` });
  }
} finally {
  await closeBrowser();
  await service.stop();
}
result.load_after = loadavg().map(rounded);
console.log(JSON.stringify(result, null, 1));
