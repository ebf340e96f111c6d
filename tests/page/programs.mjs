// The real programs over a room that slag-lab generates: a store with colours, and a robot that fetched it.

import { execFileSync, spawn } from "node:child_process";
import { mkdtempSync, readFileSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { inflateSync } from "node:zlib";

const PROGRAMS = process.env.SLAG_PROGRAMS ?? new URL("../../target/debug/", import.meta.url).pathname;
const program = (name) => join(PROGRAMS, name);

/** Runs a program to its end; its messages are shown if it fails. */
export function run(name, args) {
  return execFileSync(program(name), args, { stdio: ["ignore", "pipe", "pipe"], maxBuffer: 1 << 26 }).toString();
}

/** Starts a service and waits for its address; `stop` ends it. */
export async function serve(name, args) {
  const child = spawn(program(name), args, { stdio: ["ignore", "pipe", "pipe"] });
  let said = "";
  let complaint = "";
  const ended = new Promise((resolve) => child.on("exit", resolve));
  const url = await new Promise((resolve, reject) => {
    const look = (text) => {
      const found = text.match(/http:\/\/[^\s/]+/);
      if (found) resolve(found[0]);
    };
    child.stdout.on("data", (data) => look(said += data));
    child.stderr.on("data", (data) => look(complaint += data));
    ended.then((code) => reject(new Error(`${name} ended with ${code}: ${complaint}`)));
  });
  const stop = async () => {
    child.kill();
    await ended;
  };
  return { url, stop, child, said: () => said };
}

/** Generates a room; `close` removes it. */
export function generateRoom(nViews) {
  const folder = mkdtempSync(join(tmpdir(), "slag-page-"));
  const room = join(folder, "room");
  run("slag-lab", ["generate", "scene", "--out", room, "--n-views", String(nViews)]);
  return { folder, room, close: () => rmSync(folder, { recursive: true, force: true }) };
}

/** Generates and encodes a room. */
export function makeRoom() {
  const { folder, room, close } = generateRoom(24);
  const [store, cache] = ["store", "cache"].map((name) => join(folder, name));
  const encode = (from) => run("slag-encoder", ["encode", "--scene", join(from, "scene.ply"), "--views", join(from, "transforms.json"),
    "--masks", join(from, "gt/masks"), "--metric", "--store", store, "--appearance", "--photo-poses", "--occupancy", "--quiet"]);
  encode(room);
  /** Encodes a room with other things as the next generation. */
  const encodeAnother = () => {
    const other = join(folder, "other");
    run("slag-lab", ["generate", "scene", "--out", other, "--n-views", "8", "--seed", "2"]);
    encode(other);
  };
  const fetch = (url) => run("slag-edge", ["fetch", "--trust-first", "--from", url, "--at", "0,0,0", "--radius", "100", "--cache", cache, "--quiet"]);
  return { room, store, cache, encodeAnother, fetch, close };
}

/** Reads a grey PNG of 16 bits that is not interlaced (PNG, third edition, section 9 has the filters). */
export function readGrey16(path) {
  const file = readFileSync(path);
  const [width, height] = [file.readUInt32BE(16), file.readUInt32BE(20)];
  const chunks = [];
  for (let at = 8; at < file.length;) {
    const length = file.readUInt32BE(at);
    if (file.toString("latin1", at + 4, at + 8) === "IDAT") chunks.push(file.subarray(at + 8, at + 8 + length));
    at += 12 + length;
  }
  const data = inflateSync(Buffer.concat(chunks));
  const stride = 2 * width;
  const rows = new Uint8Array(stride * height);
  for (let y = 0; y < height; y++) {
    const filter = data[y * (stride + 1)];
    for (let x = 0; x < stride; x++) {
      const left = x >= 2 ? rows[y * stride + x - 2] : 0;
      const above = y > 0 ? rows[(y - 1) * stride + x] : 0;
      const corner = x >= 2 && y > 0 ? rows[(y - 1) * stride + x - 2] : 0;
      const estimate = left + above - corner;
      const [a, b, c] = [left, above, corner].map((v) => Math.abs(estimate - v));
      const paeth = a <= b && a <= c ? left : b <= c ? above : corner;
      rows[y * stride + x] = data[y * (stride + 1) + 1 + x] + [0, left, above, (left + above) >> 1, paeth][filter];
    }
  }
  return { width, height, at: (x, y) => (rows[y * stride + 2 * x] << 8) | rows[y * stride + 2 * x + 1] };
}
