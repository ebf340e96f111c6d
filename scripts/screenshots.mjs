// Pictures of the page for README and docs: a labelled photo's pose, a question in the box, the scene lit.
// usage: node scripts/screenshots.mjs OUT.png SCENE_DIR POSES CAMERA QUESTION [flags of `slag-encoder encode`]
//   after `scripts/setup.sh page` and a build with the page. SCENE_DIR has the splat and POSES; `generate` makes a room and a
//   yard instead. CAMERA: the number of a photo of transforms.json, or X,Y,Z,X,Y,Z: where it is and what it looks at.

import { mkdirSync, mkdtempSync, readdirSync, readFileSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { dirname, join } from "node:path";
import { closeBrowser, openBrowser, opened, picture } from "../tests/page/browser.mjs";
import { run, serve } from "../tests/page/programs.mjs";

const [out, scene, posesName, cameraIn, question, ...flags] = process.argv.slice(2);
const folder = mkdtempSync(join(tmpdir(), "slag-screenshots-"));
let dir = scene;
if (scene === "generate") {
  dir = join(folder, "scene");
  run("slag-lab", ["generate", "scene", "--kind", "room,yard", "--seed", "7", "--n-views", "48", "--out", dir, "--quiet"]);
}

/** A step behind a photo, where more is in sight. OpenGL's cameras look against z. */
function photoCamera(number) {
  const matrix = JSON.parse(readFileSync(poses, "utf8")).frames[number].transform_matrix.slice(0, 3);
  const along = (metres) => matrix.map((row) => (row[3] - metres * row[2]).toFixed(3));
  return [...along(-0.3), ...along(2)].join(",");
}

const splat = join(dir, readdirSync(dir).find((name) => name.endsWith(".ply")));
const poses = join(dir, posesName);
const store = join(folder, "store");
run("slag-encoder", ["encode", "--scene", splat, "--views", poses, "--metric", "--store", store, "--quiet", ...flags]);
const viewer = await serve("slag-encoder", ["view", "--store", store, "--scene", splat, "--views", poses, "--listen", "127.0.0.1:0", "--no-open"]);
await openBrowser();
try {
  const camera = cameraIn.includes(",") ? cameraIn : photoCamera(Number(cameraIn));
  await opened(viewer.url, async (page) => {
    const wait = { timeout: 300000 };
    await page.waitForFunction(() => document.documentElement.dataset.complete !== undefined, null, wait);
    await page.waitForFunction((q) => document.documentElement.dataset.answered === q, question, wait);
    await picture(page, null);
    mkdirSync(dirname(out), { recursive: true });
    await page.screenshot({ path: out });
  }, { isLookedAt: true, fragment: `q=${encodeURIComponent(question)}&camera=${camera}` });
} finally {
  await closeBrowser();
  await viewer.stop();
  rmSync(folder, { recursive: true, force: true });
}
