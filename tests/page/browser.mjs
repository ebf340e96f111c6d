// Chromium with a software GPU, and helpers of the tests.

import assert from "node:assert/strict";
import { mkdirSync, readFileSync } from "node:fs";
import { createRequire } from "node:module";

/** Options of a test that is left to the nightly checks, which set this variable. */
export const NIGHTLY = { skip: process.env.SLAG_NIGHTLY ? false : "nightly" };

const fromPage = createRequire(new URL("../../common/view/web/package.json", import.meta.url));
const { chromium } = fromPage("playwright-core");
export const axe = readFileSync(fromPage.resolve("axe-core/axe.min.js"), "utf8");

const PICTURES = process.env.SLAG_PAGE_PICTURES;
/**
 * With SLAG_PAGE_DIST=1 the page's files are those last built, not those in the programs: no build of them
 * while the page is worked on.
 */
const DIST = process.env.SLAG_PAGE_DIST ? new URL("../../common/view/dist/", import.meta.url) : null;
const SIZE = { width: 1100, height: 640 };

/**
 * Starts Chromium. CHROMIUM: its program; CHROMIUM_GPU: the flags that choose a GPU, instead of those of one in
 * software.
 */
export const launch = () => chromium.launch({
  executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
  args: ["--no-sandbox", ...(process.env.CHROMIUM_GPU ?? "--use-angle=swiftshader --enable-unsafe-swiftshader").split(" ")],
});

let browser;
export async function openBrowser() {
  browser = await launch();
}

export const closeBrowser = () => browser?.close();

/**
 * Opens the page of a service, or "about:blank" of one with this origin; fails at errors in the console and
 * requests to others, but for those expected. `isLookedAt`: the picture is looked at; else it has a sixteenth of the pixels, which
 * take their time without a GPU.
 */
export async function opened(url, run, { fragment = "", options = {}, expected = null, origin = url, isLookedAt = false } = {}) {
  const context = await browser.newContext({ viewport: SIZE, deviceScaleFactor: isLookedAt || PICTURES ? 1 : 0.25, colorScheme: "dark", reducedMotion: "reduce", bypassCSP: false, ...options });
  const page = await context.newPage();
  const wrong = [];
  page.on("console", (message) => message.type() === "error" && wrong.push(message.text()));
  page.on("pageerror", (error) => wrong.push(String(error)));
  page.on("request", (request) => {
    const asked = request.url();
    if (!asked.startsWith(origin) && !asked.startsWith("blob:") && !asked.startsWith("data:")) wrong.push(`foreign request: ${asked}`);
  });
  const name = (asked) => new URL(asked).pathname.replace(/^\/view\/?/, "") || "index.html";
  if (DIST) await context.route(({ pathname }) => /^\/view(\/|$)/.test(pathname), (route) => route.fulfill({ path: new URL(name(route.request().url()), DIST).pathname }));
  try {
    await page.goto(url === "about:blank" ? url : `${url}/view#${fragment}`);
    await run(page);
    assert.deepEqual(wrong.filter((text) => !expected?.test(text)), []);
  } finally {
    await context.close();
  }
}

/** Opens a file on its own; fails at errors in the console and at any request but for the file. */
export async function openedFile(path, run) {
  const page = await browser.newPage({ viewport: SIZE });
  const wrong = [];
  page.on("console", (message) => message.type() === "error" && wrong.push(message.text()));
  page.on("request", (request) => !/^(file|data):/.test(request.url()) && wrong.push(request.url()));
  try {
    await page.goto(`file://${path}`);
    await run(page);
    assert.deepEqual(wrong, []);
  } finally {
    await page.close();
  }
}

/** Longest time for a picture: without a GPU a large scene takes many seconds on a busy machine. */
const PATIENT = { timeout: 120_000 };

/** Waits until two pictures in a row are equal. */
export async function picture(page, name) {
  let last = null;
  for (let i = 0; i < 40; i++) {
    const next = await page.screenshot(PATIENT);
    if (last?.equals(next)) break;
    last = next;
    await page.waitForTimeout(250);
  }
  if (PICTURES && name) {
    mkdirSync(PICTURES, { recursive: true });
    await page.screenshot({ ...PATIENT, path: `${PICTURES}/${name}.png` });
  }
  return last;
}

/** Takes a picture for people to look at, if one is wanted. */
export const keepPicture = async (page, name) => PICTURES && picture(page, name);

/**
 * Switches something that is drawn on or off: `boxes`, `grid`, `cells`, `photos` or `changes`. Without a pointer, which would wait
 * for a picture.
 */
export const layer = (page, name, isShown) => page.locator(`#show-${name}`).evaluate((box, wanted) => box.checked === wanted || box.click(), isShown);

/** Pixels of strong colour beside the panel; the scene itself is grey. */
export async function litPixels(page, leftPx, name) {
  await layer(page, "boxes", false);
  await layer(page, "grid", false);
  await page.evaluate(() => { document.getElementById("hud").hidden = true; });
  return pixels(page, leftPx, (r, g, b) => r > 90 && r - Math.min(g, b) > 45, name);
}

/**
 * Pixels beside the panel for which a function of red, green and blue is true, in a picture that stands still,
 * or at once.
 */
export async function pixels(page, leftPx, test, name, isStill = true) {
  const png = (isStill ? await picture(page, name) : await page.screenshot(PATIENT)).toString("base64");
  const scratch = await browser.newPage();
  try {
    return await scratch.evaluate(async ([data, left, source]) => {
      const test = new Function(`return ${source}`)();
      const image = await createImageBitmap(new Blob([Uint8Array.from(atob(data), (c) => c.charCodeAt(0))]));
      const context = new OffscreenCanvas(image.width, image.height).getContext("2d");
      context.drawImage(image, 0, 0);
      const { data: rgba, width, height } = context.getImageData(0, 0, image.width, image.height);
      const found = [];
      for (let y = 0; y < height; y++) {
        for (let x = left; x < width; x++) {
          const at = 4 * (y * width + x);
          if (test(rgba[at], rgba[at + 1], rgba[at + 2])) found.push([x, y]);
        }
      }
      return found;
    }, [png, leftPx, String(test)]);
  } finally {
    await scratch.close();
  }
}
