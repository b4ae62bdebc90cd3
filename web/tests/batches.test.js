// A list of questions: pasted, watched, taken home.

import assert from "node:assert/strict";
import { readFile } from "node:fs/promises";
import { after, before, test } from "node:test";
import { keep, openPage, startBrowser } from "./support/browser.js";
import { parsedSample, startService } from "./support/service.js";

let service, browser;
before(async () => {
  service = await startService();
  browser = await startBrowser();
  await parsedSample(service.api);
});
after(async () => {
  await browser?.close();
  await service?.stop();
});

test("questions are pasted, results arrive in order, and are downloaded as JSONL and CSV", async () => {
  const { page, complaints, close } = await openPage(browser, `${service.page}/#/batches`);
  await page.getByLabel("Questions").fill('the red sofa\nhow many mugs are there?\n{"query": "the purple beds", "top_k": 3}\n{"top_k": 3}');
  await page.getByText("4 questions").waitFor();
  await page.getByRole("button", { name: "Ask all" }).click();
  const rows = page.locator(".results tbody tr");
  await rows.nth(3).waitFor();
  assert.match(await rows.nth(0).textContent(), /the red sofa.*uncertain/);
  assert.match(await rows.nth(2).textContent(), /the purple beds.*no match/);
  // What is wrong with one question fails that one alone, and says why.
  assert.match(await rows.nth(3).textContent(), /query/);
  await page.getByText("4 of 4 answered").waitFor();

  await keep(page, "batch");
  const save = async (name) => {
    const [file] = await Promise.all([page.waitForEvent("download"), page.getByRole("button", { name: `Download ${name}` }).click()]);
    return readFile(await file.path(), "utf8");
  };
  const lines = (await save("JSONL")).trim().split("\n").map((line) => JSON.parse(line));
  assert.deepEqual(lines.map(({ item }) => item), [0, 1, 2, 3]);
  const table = await save("CSV");
  assert.ok(table.includes("the red sofa") && table.trim().split(/\r?\n/).length === 5, table);
  assert.deepEqual(complaints, []);
  await close();
});

test("questions of a batch are not among those that were asked by hand", async () => {
  const { scenes } = await (await fetch(`${service.api}/v1/scenes`)).json();
  const list = { items: [{ query: "the green stool" }, { query: "the plant" }], defaults: { scene_id: scenes[0].id }, label: "two questions" };
  const post = { method: "POST", headers: { "content-type": "application/json" } };
  const { job_id } = await (await fetch(`${service.api}/v1/batches`, { ...post, body: JSON.stringify(list) })).json();
  await (await fetch(`${service.api}/v1/jobs/${job_id}/events`)).text();
  const { page, complaints, close } = await openPage(browser, `${service.page}/#/scenes/${scenes[0].id}`);
  await page.getByLabel("Question").fill("the window");
  await page.keyboard.press("Enter");
  await page.getByRole("article", { name: "Answer" }).waitFor();
  const before = page.locator(".history", { hasText: "Asked before" });
  await before.getByRole("button", { name: /the window/ }).waitFor();
  assert.equal(await before.getByText(/green stool|the plant/).count(), 0);
  await page.locator(".history", { hasText: "Batches about this room" }).getByRole("link", { name: /two questions/ }).click();
  await page.getByRole("heading", { name: "two questions" }).waitFor();
  assert.deepEqual(complaints, []);
  await close();
});

test("a room that notes its view while it is being left does not lead back", async () => {
  const { scenes } = await (await fetch(`${service.api}/v1/scenes`)).json();
  const { page, complaints, close } = await openPage(browser, `${service.page}/#/scenes/${scenes[0].id}`);
  await page.getByRole("tab", { name: "Photos" }).waitFor();
  await page.evaluate(() => {
    location.hash = "#/batches";
    // Before `hashchange` arrives.
    [...document.querySelectorAll("[role=tab]")].find((tab) => /Photos/.test(tab.textContent)).click();
  });
  await page.getByRole("heading", { name: "Batches", exact: true }).waitFor({ timeout: 5000 });
  assert.equal(new URL(page.url()).hash, "#/batches");
  assert.deepEqual(complaints, []);
  await close();
});

test("a line that can not be read is named before anything is sent", async () => {
  const { page, close } = await openPage(browser, `${service.page}/#/batches`);
  await page.getByLabel("Questions").fill('the red sofa\n{"query": "the');
  await page.getByText("Line 2 starts like JSON but is not valid JSON.").waitFor();
  assert.equal(await page.getByRole("button", { name: "Ask all" }).isDisabled(), true);
  await close();
});
