import { existsSync, readFileSync } from "node:fs";
import { defineConfig } from "vite";

/** What of others is in the page: their licences go along. */
const CARRIED = ["three", "preact", "@preact/signals", "@preact/signals-core", "tus-js-client", "js-base64", "url-parse", "querystringify", "requires-port"];
const licenceOf = (name) => ["LICENSE", "LICENSE.md"].map((file) => `node_modules/${name}/${file}`).find(existsSync);

const licences = {
  name: "licences",
  generateBundle() {
    const source = CARRIED.map((name) => `${name}\n\n${readFileSync(licenceOf(name), "utf8").trim()}\n`).join("\n\n");
    this.emitFile({ type: "asset", name: "licences.txt", source });
  },
};


/** Where a running service is, for `npm run dev`. */
const server = process.env.UNIGROUND_URL ?? "http://127.0.0.1:8080";

export default defineConfig({
  // Relative, for a service below a prefix of a proxy.
  base: "./",
  plugins: [licences],
  // Its sources: what it offers first is written for browsers of ten years ago.
  resolve: { alias: { "tus-js-client": "tus-js-client/lib/browser/index.js" } },
  server: { proxy: { "/v1": server, "/docs": server, "/openapi.json": server, "/readyz": server } },
  build: {
    target: "es2022",
    outDir: "dist",
    emptyOutDir: true,
    assetsInlineLimit: 0,
    // The polyfill is an inline script, which the page's policy forbids, and no browser of today needs it.
    modulePreload: { polyfill: false },
    // build/finish.js prints sizes as a browser loads them.
    reportCompressedSize: false,
    chunkSizeWarningLimit: 800,
  },
});
