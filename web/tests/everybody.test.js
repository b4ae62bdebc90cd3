// By keyboard alone, by screen reader, in light and dark, on a narrow screen, and with a key.

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { after, before, test } from "node:test";
import { drawn, keep, openPage, startBrowser } from "./support/browser.js";
import { parsedSample, startService } from "./support/service.js";

const AXE = readFileSync(createRequire(import.meta.url).resolve("axe-core/axe.min.js"), "utf8");
const KEY = "a-key-for-tests-0123456789abcdef0123456789";

let service, browser, scene;
before(async () => {
  service = await startService({ environment: { UNIGROUND_API_KEY: KEY } });
  browser = await startBrowser();
  scene = await parsedSample(service.api, { authorization: `Bearer ${KEY}` });
});
after(async () => {
  await browser?.close();
  await service?.stop();
});

/** A page of somebody who has entered the key. */
async function open(path = "", options = {}) {
  const opened = await openPage(browser, "about:blank", options);
  await opened.page.addInitScript((key) => sessionStorage.setItem("uniground.key", key), KEY);
  await opened.page.goto(`${service.page}/${path}`);
  return opened;
}

test("a key is asked for once, kept for the tab, and opens pictures and events too", async () => {
  const { page, complaints, close } = await openPage(browser, service.page);
  const origins = new Set();
  page.on("request", (request) => {
    if (request.headers().authorization) origins.add(new URL(request.url()).origin);
  });
  await page.getByRole("dialog").getByLabel("API key").fill(KEY);
  await page.keyboard.press("Enter");
  const thumbnail = page.locator(".card img");
  await thumbnail.waitFor();
  assert.match(await thumbnail.getAttribute("src"), /^blob:/);
  assert.deepEqual(await thumbnail.evaluate(({ naturalWidth, naturalHeight }) => [naturalWidth, naturalHeight]), [320, 240]);
  await page.getByRole("link", { name: "living room" }).click();
  await page.getByLabel("Question").fill("the red sofa");
  await page.keyboard.press("Enter");
  await page.getByRole("button", { name: "Why this answer" }).click();
  await page.locator(".why .picture img").waitFor();
  await drawn(page);
  assert.deepEqual([...origins], [new URL(service.page).origin]);
  assert.equal(await page.evaluate((key) => JSON.stringify({ ...localStorage }).includes(key) || document.cookie.includes(key), KEY), false);
  assert.deepEqual(complaints, []);
  await close();
});

test("everything is reached by keyboard alone", async () => {
  const { page, complaints, close } = await open();
  const tabTo = async (name) => {
    for (let i = 0; i < 60; i++) {
      await page.keyboard.press("Tab");
      const focused = await page.evaluate(() => {
        const element = document.activeElement;
        if (element?.role === "tabpanel") return "";
        return element?.getAttribute("aria-label") ?? element?.labels?.[0]?.textContent ?? element?.textContent ?? "";
      });
      if (focused.trim().startsWith(name)) return;
    }
    assert.fail(`${name} is never reached`);
  };
  await page.getByRole("link", { name: "living room" }).waitFor();
  await tabTo("Skip to content");
  await page.keyboard.press("Enter");
  await tabTo("choose a file");
  await tabTo("living room");
  await page.keyboard.press("Enter");
  await drawn(page);
  await tabTo("living room in three dimensions");
  const before = await page.evaluate(() => window.unigroundPage.camera().position);
  await page.keyboard.press("ArrowLeft");
  await page.keyboard.press("+");
  await page.waitForTimeout(200);
  assert.notDeepEqual(await page.evaluate(() => window.unigroundPage.camera().position), before);
  await tabTo("Ask");
  await tabTo("Question");
  await page.keyboard.type("the red sofa");
  await page.keyboard.press("Enter");
  await page.getByRole("article", { name: "Answer" }).waitFor();
  // Tabs are one stop; arrows move between them.
  await page.getByRole("tab", { name: "Ask" }).focus();
  await page.keyboard.press("ArrowRight");
  await page.keyboard.press("ArrowRight");
  await tabTo("Search names");
  await page.keyboard.type("lamp");
  await tabTo("Show");
  await page.keyboard.press("Tab");
  await page.keyboard.press("Enter");
  await page.locator("[data-instance]").waitFor();
  await tabTo("Measure from here");
  assert.deepEqual(complaints, []);
  await close();
});

for (const colorScheme of ["light", "dark"]) {
  test(`nobody is shut out: axe finds nothing serious, ${colorScheme}`, async () => {
    const { page, close } = await open("", { colorScheme });
    const check = async (place) => {
      // The policy forbids scripts of others: axe comes in by the debugger.
      await page.evaluate(`typeof axe === "undefined" ? (${JSON.stringify(AXE)}, 0) : 0`);
      if (!(await page.evaluate(() => typeof window.axe !== "undefined"))) await page.evaluate(AXE);
      const found = await page.evaluate(() => window.axe.run(document, { resultTypes: ["violations"] }));
      const serious = found.violations.filter(({ impact }) => impact === "serious" || impact === "critical");
      const words = serious.map(({ id, nodes }) => `${id}: ${nodes.map(({ html }) => html).join(" ")}`);
      assert.deepEqual(words, [], place);
    };
    await page.locator(".card img").waitFor();
    await keep(page, `scenes-${colorScheme}`);
    await check("scenes");
    await page.getByRole("link", { name: "living room" }).click();
    await drawn(page);
    await page.getByLabel("Question").fill("the zorgly red chair near the table");
    await page.keyboard.press("Enter");
    await page.getByRole("article", { name: "Answer" }).waitFor();
    await page.getByText("Answer options").click();
    await page.getByText(/^All candidates \(/).click();
    await keep(page, `answer-${colorScheme}`);
    await check("an answer");
    await page.getByRole("tab", { name: "Why" }).click();
    await page.locator(".why img").waitFor();
    await check("why");
    await page.getByRole("tab", { name: "Objects" }).click();
    await check("things");
    await page.locator(".panel .line").nth(3).click({ modifiers: ["Control"] });
    await page.locator(".panel .line").nth(4).click({ modifiers: ["Control"] });
    await check("a selection");
    await page.getByRole("button", { name: "Cancel" }).click();
    await page.locator(".panel .line").first().click();
    await check("a thing");
    await page.getByRole("button", { name: "Rename" }).click();
    await page.getByLabel("New name").fill("the ground");
    await page.keyboard.press("Enter");
    await page.getByRole("heading", { name: /^the ground/ }).waitFor();
    await page.locator("details.corrections summary").click();
    await page.getByRole("button", { name: /^Undo/ }).first().waitFor();
    await keep(page, `corrections-${colorScheme}`);
    await check("corrections");
    await page.getByRole("button", { name: /^Undo/ }).first().click();
    await page.getByText(/undone/).first().waitFor();
    await check("a correction that was taken back");
    await page.getByRole("tab", { name: "Photos" }).click();
    await page.getByLabel("Show camera positions in the room").check();
    await page.getByRole("button", { name: "Photo 3" }).first().click();
    await page.locator(".photograph img").waitFor();
    await keep(page, `photograph-${colorScheme}`);
    await check("a photograph");
    await page.keyboard.press("Escape");
    await check("photographs");
    await page.getByRole("tab", { name: "Report" }).click();
    await page.getByRole("heading", { name: "Stages" }).waitFor();
    await check("report");
    await page.getByRole("button", { name: "Key" }).click();
    await check("the key");
    await page.keyboard.press("Escape");
    await page.getByRole("link", { name: "Batches" }).click();
    await page.getByLabel("Questions").fill("the red sofa");
    await check("batches");
    await close();
  });
}

test("a screen of 360 pixels has everything and never scrolls sideways", async () => {
  const { page, complaints, close } = await open("", { viewport: { width: 360, height: 740 }, hasTouch: true, isMobile: true });
  const fits = async (place) => {
    const width = await page.evaluate(() => document.documentElement.scrollWidth);
    assert.ok(width <= 360, `${place} is ${width} wide`);
  };
  await page.locator(".card img").waitFor();
  await fits("scenes");
  await page.getByRole("link", { name: "living room" }).tap();
  await drawn(page);
  await page.getByLabel("Question").fill("the mug on the coffee table");
  await page.getByRole("button", { name: "Ask", exact: true }).tap();
  await page.getByRole("article", { name: "Answer" }).waitFor();
  await fits("an answer");
  await keep(page, "narrow");
  // The question is above the room, and the controls of the view are behind one button.
  const top = async (locator) => (await locator.boundingBox()).y;
  assert.ok((await top(page.getByLabel("Question"))) < (await top(page.locator("canvas"))));
  assert.equal(await page.getByRole("button", { name: "Walk", exact: true }).count(), 0);
  await page.getByRole("button", { name: "View", exact: true }).tap();
  await fits("the controls of the view");
  await keep(page, "narrow-view");
  await page.getByRole("button", { name: "Whole room" }).tap();
  assert.equal(await page.getByRole("button", { name: "Walk", exact: true }).count(), 0);
  for (const tab of ["Why", "Objects", "Photos", "Report"]) {
    await page.getByRole("tab", { name: tab }).tap();
    await page.waitForTimeout(300);
    await fits(tab);
  }
  await page.getByRole("tab", { name: "Objects" }).tap();
  for (const number of [4, 5]) {
    await page.locator(".panel .line").nth(number).tap();
    await page.getByRole("button", { name: "Add to selection" }).tap();
    await page.getByRole("button", { name: "← Back to the list" }).tap();
  }
  await page.locator("details.corrections summary").tap();
  await fits("a selection and corrections");
  await keep(page, "narrow-selection");
  await page.getByRole("tab", { name: "Photos" }).tap();
  await page.getByRole("button", { name: "Photo 3" }).first().tap();
  await page.locator(".photograph img").waitFor();
  await fits("a photograph");
  await keep(page, "narrow-photograph");
  await page.getByRole("button", { name: "Close" }).tap();
  await page.getByRole("link", { name: "Batches" }).tap();
  await page.getByLabel("Questions").waitFor();
  await fits("batches");
  assert.deepEqual(complaints, []);
  await close();
});
