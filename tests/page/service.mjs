// A service with the page's protocol over a small known scene, which can refuse, vanish and publish at will.

import { createReadStream, readFileSync, statSync } from "node:fs";
import { createServer } from "node:http";

const DIST = new URL("../../common/view/dist/", import.meta.url);
const POLICY = readFileSync(new URL("../../common/view/src/csp.txt", import.meta.url), "utf8").trim();
const TYPES = { html: "text/html", js: "text/javascript", css: "text/css", svg: "image/svg+xml" };

/** Boxes in world metres that hold Gaussians, grey all of them. */
export const THINGS = [
  { name: "floor", min: [-4, -4, -0.1], max: [4, 4, 0], n: [64, 64, 1] },
  { name: "chair", min: [0.5, 0.5, 0], max: [1.9, 1.1, 1], n: [16, 8, 12] },
  { name: "ball", min: [-2, -1.5, 0], max: [-1, -0.5, 1], n: [12, 12, 12] },
];

/** Two places to stand near the chair, as `/v1/goal` names them. */
export const GOALS = [
  { position_in_world: [1.2, -1, 0], yaw_rad: 1.571, sensor_in_world: [1.2, -1, 0.4], clearance_m: 0.75, visible_share: 0.61, path_m: 4.25 },
  { position_in_world: [-0.2, 0.9, 0], yaw_rad: -0.1, sensor_in_world: [-0.2, 0.9, 0.4], clearance_m: 0.52, visible_share: 0.44, path_m: 5.5 },
];

/** "seat" lights what "chair" does, and finds no object. */
const WORDS = [["chair", 1], ["ball", 1], ["wall", 0], ["armchair", 0], ["red wall", 0]].map(([word, n_things]) => ({ word, n_things }));

/** What the robot's routes take of what the page may send; they refuse the rest. */
const PARAMETERS = {
  "/v1/view": [],
  "/v1/view/cells": ["generation", "step"],
  "/v1/view/scores": ["text", "negative"],
  "/v1/query": ["text", "negative", "limit", "near", "heading_rad"],
  "/v1/goal": ["id", "radius_m"],
  "/v1/view/words": [],
  "/v1/changes": [],
  "/v1/map": [],
  "/v1/objects": ["near", "radius", "limit"],
};

/** A picture whose left half is red and whose right half is blue. */
const PICTURE = '<svg xmlns="http://www.w3.org/2000/svg" width="640" height="480"><rect width="320" height="480" fill="#f00"/><rect x="320" width="320" height="480" fill="#00f"/></svg>';

function half(value) {
  if (value === 0) return 0;
  const sign = value < 0 ? 0x8000 : 0;
  const exponent = Math.floor(Math.log2(Math.abs(value)));
  return exponent < -14 ? sign : sign | ((exponent + 15) << 10) | Math.floor((Math.abs(value) / 2 ** exponent - 1) * 1024);
}

/** Every `step`-th of a thing's Gaussians; a few larger ones stand for all. */
function cellMessage(thing, step) {
  const n = Math.ceil(thing.n.reduce((a, b) => a * b) / step);
  const origin = thing.min.map((low, i) => (low + thing.max[i]) / 2);
  const bytes = Buffer.alloc(32 + 16 * n);
  bytes.write("SLGG");
  bytes.writeUInt32LE(1, 4);
  bytes.writeUInt32LE(n, 8);
  origin.forEach((v, i) => bytes.writeFloatLE(v, 12 + 4 * i));
  bytes.writeUInt32LE(1, 24);
  bytes.writeUInt32LE(step, 28);
  const sigma = thing.min.map((low, i) => ((thing.max[i] - low) / thing.n[i]) * 0.5 * Math.sqrt(step));
  for (let i = 0; i < n; i++) {
    const of = i * step;
    const at = [of % thing.n[0], Math.floor(of / thing.n[0]) % thing.n[1], Math.floor(of / thing.n[0] / thing.n[1])];
    for (let k = 0; k < 3; k++) {
      const centre = thing.min[k] + ((at[k] + 0.5) / thing.n[k]) * (thing.max[k] - thing.min[k]) - origin[k];
      bytes.writeUInt16LE(half(centre), 32 + 6 * i + 2 * k);
      bytes[32 + 6 * n + 3 * i + k] = 110;
      bytes[32 + 10 * n + 3 * i + k] = Math.round(((Math.log(sigma[k]) + 12) * 254) / 21) + 1;
      bytes[32 + 13 * n + 3 * i + k] = k < 2 ? 128 : 0;
    }
    bytes[32 + 9 * n + i] = 230;
  }
  return bytes;
}

function scoresMessage(things, text, generation) {
  const counts = things.map((thing) => thing.n.reduce((a, b) => a * b));
  const head = Buffer.alloc(24 + 8 * things.length);
  head.write("SLGS");
  head.writeUInt32LE(1, 4);
  head.writeFloatLE(0, 8);
  head.writeFloatLE(1, 12);
  head.writeUInt32LE(things.length, 16);
  head.writeUInt32LE(generation, 20);
  counts.forEach((n, i) => {
    head.writeUInt32LE(i, 24 + 8 * i);
    head.writeUInt32LE(n, 28 + 8 * i);
  });
  return Buffer.concat([head, ...things.map((thing, i) => Buffer.alloc(counts[i], thing.name === text ? 220 : 30))]);
}

/** Starts it on a free port; `behaviour` may be changed while it runs. */
export async function startService(behaviour = {}) {
  Object.assign(behaviour, { token: null, generation: 1, isGone: false, hasScene: true, missing: [], stale: [], requests: [], goal: "no-occupancy", id: "o1", things: THINGS, known: THINGS, none: null, threshold: 0.5, words: WORDS, hasAllWords: true, program: "slag-edge", changes: null, geographic: false, position: [-3, 3, 0], fetchedM: 0.8, photos: [], evidence: null, fails: false, refused: null, nAnswers: 1, ageSecs: 7200, ...behaviour });
  const json = (response, status, body) => response.writeHead(status, { "content-type": "application/json" }).end(JSON.stringify(body));
  const server = createServer((request, response) => {
    const url = new URL(request.url, "http://localhost");
    behaviour.requests.push(request.url);
    if (behaviour.isGone) return request.socket.destroy();
    if (url.pathname === "/view" || url.pathname.startsWith("/view/")) {
      const name = url.pathname.replace(/^\/view\/?/, "") || "index.html";
      const path = new URL(name, DIST);
      if (!path.href.startsWith(DIST.href) || !statSync(path, { throwIfNoEntry: false })?.isFile()) return response.writeHead(404).end();
      response.writeHead(200, { "content-type": TYPES[name.split(".").pop()], "content-security-policy": POLICY });
      return createReadStream(path).pipe(response);
    }
    if (behaviour.token && request.headers.authorization !== `Bearer ${behaviour.token}`) return json(response, 401, { detail: "token" });
    if (url.pathname === "/v1/events") {
      behaviour.tell = (name, data) => response.write(`event: ${name}\ndata: ${JSON.stringify(data)}\n\n`);
      return response.writeHead(200, { "content-type": "text/event-stream" }).flushHeaders();
    }
    const known = PARAMETERS[url.pathname.replace(/\/\d+$/, "")];
    const foreign = [...url.searchParams.keys()].find((name) => known && !known.includes(name));
    if (foreign) return json(response, 400, { detail: `unknown parameter ${foreign}` });
    const cell = url.pathname.match(/^\/v1\/view\/cells\/(\d+)$/);
    if (cell) return response.writeHead(200).end(cellMessage(behaviour.things[Number(cell[1])], Number(url.searchParams.get("step") ?? 1)));
    if (behaviour.refused && /query|scores/.test(url.pathname) && url.searchParams.get("text") === behaviour.refused.text) return json(response, 422, { detail: behaviour.refused.detail });
    if (url.pathname === "/v1/view/scores") return response.writeHead(200).end(scoresMessage(behaviour.things, url.searchParams.get("text").replace("seat", "chair"), behaviour.generation));
    if (url.pathname === "/v1/view/words") return json(response, 200, { generation: behaviour.generation, words: behaviour.words, complete: behaviour.hasAllWords });
    if (url.pathname === "/v1/map") return json(response, 200, { age_secs: behaviour.ageSecs, is_expired: false });
    if (url.pathname === "/v1/objects/o1/thumbnail") return response.writeHead(200, { "content-type": "image/svg+xml" }).end(PICTURE);
    if (url.pathname.startsWith("/v1/view/photos/")) return response.writeHead(200, { "content-type": "image/svg+xml" }).end(PICTURE);
    if (url.pathname === "/v1/locate") {
      behaviour.focalPx = Number(url.searchParams.get("focal_px"));
      request.resume();
      return request.on("end", () => json(response, 200, behaviour.located));
    }
    if (url.pathname === "/v1/objects") return json(response, 200, { objects: THINGS.map(({ name, min, max }, i) => ({ id: `o${i}`, names: [{ name, confidence: 0.814 }], position_in_world: min.map((low, k) => (low + max[k]) / 2), box_min_in_world: min, box_max_in_world: max })) });
    if (behaviour.fails && /query|scores/.test(url.pathname)) return json(response, 503, { detail: "too busy" });
    if (url.pathname === "/v1/changes") return behaviour.changes ? json(response, 200, behaviour.changes) : json(response, 409, { detail: "the store has one generation alone" });
    if (url.pathname === "/v1/goal") {
      if (behaviour.goal === "no-occupancy") return json(response, 409, { detail: "the scene does not say which places are free; encode it with --occupancy" });
      const isReached = behaviour.goal === "reached";
      const none = isReached ? null : { kind: behaviour.goal, detail: "within reach of it, no ground is reached" };
      return json(response, 200, { goals: isReached ? GOALS : [], thing: isReached ? { id: "o1", position_in_world: [1.2, 0.8, 0.5] } : null, none });
    }
    if (url.pathname === "/v1/query") {
      const missing = ["near", "heading_rad"].find((name) => !url.searchParams.has(name));
      const isOfAsker = url.searchParams.get("text").endsWith(" near me");
      if (isOfAsker && missing) return json(response, 400, { detail: `${missing}: found "nothing"`, parameter: missing });
      const [name, support] = url.searchParams.get("text").replace(" near me", "").split(" on the ");
      const thing = behaviour.known.find((entry) => entry.name === name);
      const understood = support ? { thing: name, relation: { is: "on", of: { thing: support } } } : null;
      const answers = thing ? Array(Math.min(behaviour.nAnswers, Number(url.searchParams.get("limit")))).fill({
        ...(support ? { degree: 0.93, related_to: [{ thing: support, position_in_world: [0, 0, 0], score: 0.7 }] } : {}),
        geographic: { latitude_deg: 48.1, longitude_deg: 11.5, height_m: 520 },
        ...(behaviour.evidence ? { evidence: behaviour.evidence } : {}),
        id: behaviour.id, score: 0.86, n_gaussians: 1536, position_in_world: thing.min.map((low, i) => (low + thing.max[i]) / 2),
        box_min_in_world: thing.min, box_max_in_world: thing.max,
      }) : [];
      const none = thing ? null : behaviour.none ?? { kind: "nothing-there", detail: "nothing found", thing: null };
      const thresholds = support ? { parts: [{ thing: name, n_found: 1, threshold: 0.5 }] } : { threshold: behaviour.threshold };
      return json(response, 200, { results: [{ question: {}, understood, answers, none, ...thresholds }] });
    }
    if (url.pathname !== "/v1/view" || !behaviour.hasScene) return json(response, 404, { detail: "nothing here" });
    json(response, 200, {
      program: behaviour.program, scene: "test room", generation: behaviour.generation, up: [0, 0, 1], metric: true, geographic: behaviour.geographic, can_ask: true, views: behaviour.photos,
      n_gaussians: behaviour.things.reduce((sum, { n }) => sum + n[0] * n[1] * n[2], 0), position_m: behaviour.position, fetched: { centre_m: [-3, 3, 0], radius_m: behaviour.fetchedM },
      cells: behaviour.things.map(({ min, max, n }, i) => ({
        cell: i, n_gaussians: n[0] * n[1] * n[2], state: behaviour.missing.includes(i) ? "missing" : behaviour.stale.includes(i) ? "stale" : "on_board", generation: behaviour.generation - (behaviour.stale.includes(i) ? 1 : 0), box_m: { min, max },
      })),
    });
  });
  await new Promise((resolve) => server.listen(0, "127.0.0.1", resolve));
  const stop = () => new Promise((resolve) => { server.closeAllConnections(); server.close(resolve); });
  return { url: `http://127.0.0.1:${server.address().port}`, behaviour, stop };
}
