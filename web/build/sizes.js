// Prints what a browser loads at first, compressed, and fails where that is more than was promised.

import { readdirSync, readFileSync } from "node:fs";
import { gzipSync } from "node:zlib";

const LIMIT_KB = 400;

const dist = new URL("../dist/", import.meta.url);
const files = ["index.html", ...readdirSync(new URL("assets/", dist)).map((name) => `assets/${name}`)].sort();
let total = 0;
for (const file of files) {
  const bytes = readFileSync(new URL(file, dist));
  const kb = gzipSync(bytes, { level: 9 }).length / 1000;
  total += kb;
  console.log(`${file.padEnd(32)} ${(bytes.length / 1000).toFixed(1).padStart(8)} kB ${kb.toFixed(1).padStart(8)} kB gzip`);
}
console.log(`${"all, an open room included".padEnd(32)} ${" ".repeat(11)} ${total.toFixed(1).padStart(8)} kB gzip (limit ${LIMIT_KB})`);
if (total > LIMIT_KB) process.exit(1);
