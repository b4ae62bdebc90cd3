// A browser without a screen, that draws WebGL in software; and what tests do with a page in it.

import { existsSync } from "node:fs";
import { fileURLToPath } from "node:url";
import { chromium } from "playwright-core";

const program = process.env.CHROMIUM ?? ["/usr/bin/chromium", "/usr/bin/chromium-browser", "/usr/bin/google-chrome"].find(existsSync);

export function startBrowser() {
  return chromium.launch({
    executablePath: program,
    args: ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
  });
}

/** A fresh page that fails its test where the page itself says that something is wrong. */
export async function openPage(browser, address, options = {}) {
  const context = await browser.newContext({ viewport: { width: 1360, height: 850 }, reducedMotion: "reduce", ...options });
  const page = await context.newPage();
  const complaints = [];
  page.on("pageerror", (error) => complaints.push(String(error)));
  page.on("console", (message) => {
    // A refused request is the service's business, and each test says what it expects of it.
    if (message.type() === "error" && !/Failed to load resource/.test(message.text())) complaints.push(message.text());
  });
  await page.goto(address);
  return { page, complaints, close: () => context.close() };
}

/** Keeps a picture of the page, for people: `web/shots/NAME.png`. */
export function keep(page, name) {
  return page.screenshot({ path: fileURLToPath(new URL(`../../shots/${name}.png`, import.meta.url)) });
}

/** Until all points are drawn and the view rests. */
export async function drawn(page) {
  await page.waitForFunction(() => {
    const { points, all } = window.unigroundPage?.loaded() ?? { all: 0 };
    return all > 0 && points === all && !window.unigroundPage.camera().moving;
  });
  await page.waitForTimeout(300);
}
