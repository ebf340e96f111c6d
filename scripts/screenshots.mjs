// Pictures of the page in six states, on a desk and on a phone, and page.webp, which goes through some of them, to be looked at;
// README and docs show some of them. img2webp is in Debian's package webp.
// usage: node scripts/screenshots.mjs OUT_DIR SCENE_DIR POSES QUESTION SECOND [flags of `slag-encoder encode`]
//   after `scripts/setup.sh page` and a build with the page. SCENE_DIR has the splat and POSES; `generate` makes a room and a
//   yard instead, whose POSES are transforms.json.

import { execFileSync } from "node:child_process";
import { mkdirSync, mkdtempSync, readdirSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { closeBrowser, openBrowser, opened, picture } from "../tests/page/browser.mjs";
import { run, serve } from "../tests/page/programs.mjs";

const [out, scene, posesName, question, second, ...flags] = process.argv.slice(2);
const WIDTHS = { desk: { width: 1280, height: 800 }, phone: { width: 390, height: 844 } };
const WAIT = { timeout: 120000 };
const folder = mkdtempSync(join(tmpdir(), "slag-screenshots-"));
let dir = scene;
if (scene === "generate") {
  dir = join(folder, "scene");
  run("slag-lab", ["generate", "scene", "--kind", "room,yard", "--seed", "7", "--n-views", "48", "--out", dir, "--quiet"]);
}

const asked = (page, line) => page.waitForFunction((q) => document.documentElement.dataset.answered === q, line, WAIT);
async function ask(page, line) {
  await page.locator("#question").fill(line);
  await asked(page, line);
}

/** Each goes on from the state before. */
const STATES = {
  opening: () => {},
  typing: async (page) => {
    await page.locator("#question").focus();
    await page.keyboard.type(question.slice(0, 2));
  },
  answers: async (page) => {
    await ask(page, question);
    await page.locator("#question").blur();
  },
  chosen: async (page, isOpen = false) => {
    if (!isOpen) await page.locator("#answers .card").first().click();
    await page.locator("#details figure svg").waitFor(WAIT).catch(() => {});
  },
  compared: async (page) => {
    await page.locator("#more").click();
    await page.locator("#second").fill(second);
    await asked(page, `${question} | ${second}`);
  },
  nothing: async (page) => {
    await page.locator("#second").fill("");
    // A model that knows some words may refuse this one, which is a state to look at, too.
    await ask(page, "elephant").catch(() => {});
  },
};

/** A film: the question is typed, the scene lights, the camera flies to the best answer, whose photo opens. */
async function film(page) {
  const frames = [];
  const take = async (milliseconds) => {
    const path = join(folder, `${frames.length}.png`);
    await page.screenshot({ path });
    frames.push("-d", String(milliseconds), path);
  };
  await take(900);
  // A screenshot takes longer than its frame is shown, so the page's clock is stopped meanwhile.
  const stop = async () => page.clock.pauseAt((await page.evaluate(() => Date.now())) + 1000);
  await page.clock.install();
  await stop();
  await page.locator("#question").focus();
  for (const letter of question) {
    await page.keyboard.type(letter);
    await take(170);
  }
  await page.clock.resume();
  await asked(page, question);
  await picture(page, null);
  await take(1500);
  await stop();
  await page.locator("#answers .card").first().click();
  for (let i = 0; i < 16; i++) {
    await page.clock.runFor(60);
    await take(80);
  }
  await page.clock.resume();
  await STATES.chosen(page, true);
  await picture(page, null);
  await take(3500);
  execFileSync("img2webp", ["-loop", "0", "-lossy", "-q", "55", "-m", "6", ...frames, "-o", join(out, "page.webp")]);
}

const splat = join(dir, readdirSync(dir).find((name) => name.endsWith(".ply")));
const poses = join(dir, posesName);
const store = join(folder, "store");
run("slag-encoder", ["encode", "--scene", splat, "--views", poses, "--metric", "--store", store, "--quiet", ...flags]);
const viewer = await serve("slag-encoder", ["view", "--store", store, "--scene", splat, "--views", poses, "--listen", "127.0.0.1:0", "--no-open"]);
mkdirSync(out, { recursive: true });
await openBrowser();
try {
  await opened(viewer.url, async (page) => {
    await page.waitForFunction(() => document.documentElement.dataset.complete !== undefined, null, WAIT);
    await picture(page, null);
    await film(page);
  }, { isLookedAt: true, options: { viewport: { width: 960, height: 600 }, reducedMotion: "no-preference" }, expected: /422/ });
  for (const [name, viewport] of Object.entries(WIDTHS)) {
    await opened(viewer.url, async (page) => {
      await page.waitForFunction(() => document.documentElement.dataset.complete !== undefined, null, WAIT);
      for (const [state, reach] of Object.entries(STATES)) {
        await reach(page);
        await picture(page, null);
        await page.screenshot({ path: join(out, `${state}-${name}.png`) });
      }
    }, { isLookedAt: true, options: { viewport }, expected: /40[04]|422/ });
  }
} finally {
  await closeBrowser();
  await viewer.stop();
  rmSync(folder, { recursive: true, force: true });
}
