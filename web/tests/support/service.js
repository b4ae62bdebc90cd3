// A real service of its own, on a free port, with its data in a folder that goes away.

import { spawn } from "node:child_process";
import { cpSync, mkdtempSync, readFileSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { createInterface } from "node:readline";
import { fileURLToPath } from "node:url";
import { front } from "./front.js";

const root = fileURLToPath(new URL("../../../", import.meta.url));
const program = process.env.UNIGROUND ?? join(root, "target/release/uniground");
export const SAMPLE = join(root, "examples/living_room.zip");

/** A data folder that has the sample scan parsed: made once by `prepare.js`, copied by whoever asks for it. */
const prepared = process.env.UNIGROUND_SAMPLE_DATA;

/** With `UNIGROUND_PAGE=dist` tests use web/dist in front of the service, whatever page the program has. */
const useDist = process.env.UNIGROUND_PAGE === "dist";

/** Starts `uniground serve`. `page` is the address of the page: the service's own, or web/dist in front of it. */
export async function startService({ further = [], environment = {}, empty = false } = {}) {
  const data = mkdtempSync(join(tmpdir(), "uniground-page-"));
  if (prepared && !empty) cpSync(prepared, data, { recursive: true });
  const parameters = ["serve", "--listen", "127.0.0.1:0", "--data-dir", data, "--masks", "builtin", "--encoder", "builtin", ...further];
  const child = spawn(program, parameters, { stdio: ["ignore", "pipe", "inherit"], env: { ...process.env, RUST_LOG: "warn", ...environment } });
  const api = await listening(child);
  const own = !useDist && await fetch(`${api}/viewer`).then((reply) => reply.ok);
  const before = own ? null : await front(api);
  return {
    api,
    page: before?.address ?? api,
    data,
    async stop(keep = false) {
      before?.close();
      child.kill("SIGTERM");
      await new Promise((resolve) => child.once("exit", resolve));
      if (!keep) rmSync(data, { recursive: true, force: true });
    },
  };
}

function listening(child) {
  return new Promise((resolve, reject) => {
    child.once("error", reject);
    child.once("exit", (code) => reject(new Error(`the service ended with ${code}`)));
    createInterface({ input: child.stdout }).on("line", (line) => {
      const address = /listening on (http:\S+)/.exec(line);
      if (address) resolve(address[1]);
    });
  });
}

/** The sample scan, uploaded and parsed without the page, unless it is there already. */
export async function parsedSample(api, headers = {}) {
  const there = await fetch(`${api}/v1/scenes`, { headers }).then((reply) => reply.json());
  if (there.scenes[0]?.status === "ready") return there.scenes[0];
  const created = await fetch(`${api}/v1/scenes?name=living%20room`, {
    method: "POST",
    headers: { "content-type": "application/zip", ...headers },
    body: readFileSync(SAMPLE),
  }).then((reply) => reply.json());
  for (;;) {
    const scene = await fetch(`${api}/v1/scenes/${created.scene.id}`, { headers }).then((reply) => reply.json());
    if (scene.status === "ready") return scene;
    if (scene.status === "failed") throw new Error(JSON.stringify(scene.error));
    await new Promise((resolve) => setTimeout(resolve, 200));
  }
}
