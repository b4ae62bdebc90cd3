// The parse is wrong, and somebody says so: it is kept, later answers go by it, and it can be taken back.

import assert from "node:assert/strict";
import { readFile } from "node:fs/promises";
import { after, before, test } from "node:test";
import { drawn, keep, openPage, startBrowser } from "./support/browser.js";
import { parsedSample, startService } from "./support/service.js";

let service, browser, scene;
before(async () => {
  service = await startService();
  browser = await startBrowser();
  scene = await parsedSample(service.api);
});
after(async () => {
  await browser?.close();
  await service?.stop();
});

const open = (query = "") => openPage(browser, `${service.page}/#/scenes/${scene.id}${query}`);

/** Asks, and returns what came of it as the service sent it. */
async function ask(page, question) {
  await page.getByRole("tab", { name: "Ask" }).click();
  await page.getByLabel("Question").fill(question);
  const [reply] = await Promise.all([page.waitForResponse(/\/ground$/), page.keyboard.press("Enter")]);
  const answer = await reply.json();
  await page.locator(`[data-answer="${answer.id}"]`).waitFor();
  return answer;
}

/** Opens the list of things, and the thing of that number in it. */
async function openThing(page, id) {
  await page.getByRole("tab", { name: "Objects" }).click();
  if (await page.locator(`[data-instance="${id}"]`).isVisible()) return;
  await row(page, id).click();
  await page.locator(`[data-instance="${id}"]`).waitFor();
}

const row = (page, id) => page.locator(".panel .line", { has: page.getByText(String(id), { exact: true }) });

async function undoAll(page) {
  await page.getByRole("tab", { name: "Objects" }).click();
  const corrections = page.locator("details.corrections");
  if ((await corrections.getAttribute("open")) === null) await corrections.locator("summary").click();
  const undo = corrections.getByRole("button", { name: /^Undo/ });
  for (let left = await undo.count(); left > 0; left--) {
    await undo.first().click();
    await page.waitForFunction((n) => document.querySelectorAll(".corrections .correction:not([data-undone=true])").length < n, left);
  }
}

test("a new name survives a reload, and questions find the thing by it", async () => {
  const { page, complaints, close } = await open();
  await drawn(page);
  const { answer } = await ask(page, "the plant");
  await openThing(page, answer.predicted_id);
  await page.getByRole("button", { name: "Rename" }).click();
  await page.getByLabel("New name").fill("umbrella");
  await page.keyboard.press("Enter");
  await page.getByRole("heading", { name: /^umbrella/ }).waitFor();
  await page.reload();
  await drawn(page);
  const renamed = await ask(page, "the umbrella");
  assert.equal(renamed.answer.predicted_id, answer.predicted_id);
  await keep(page, "renamed");

  await undoAll(page);
  await openThing(page, answer.predicted_id);
  assert.equal(await page.getByRole("heading", { name: /^umbrella/ }).count(), 0);
  assert.deepEqual(complaints, []);
  await close();
});

test("junk is never an answer, until it is taken back", async () => {
  const { page, complaints, close } = await open();
  await drawn(page);
  const { answer } = await ask(page, "the red sofa");
  await openThing(page, answer.predicted_id);
  await page.getByRole("button", { name: "This is junk" }).click();
  await page.getByRole("status").getByText("Saved. Later answers use it.").waitFor();
  await page.reload();
  await drawn(page);
  const without = await ask(page, "the red sofa");
  assert.notEqual(without.answer.predicted_id, answer.predicted_id);
  await page.getByRole("tab", { name: "Objects" }).click();
  assert.equal(await row(page, answer.predicted_id).count(), 0);
  await page.getByLabel("Show").selectOption("junk");
  await row(page, answer.predicted_id).waitFor();
  await page.getByLabel("Show").selectOption("objects");

  await undoAll(page);
  await row(page, answer.predicted_id).waitFor();
  assert.match(await page.locator(".correction").first().textContent(), /undone/);
  assert.equal((await ask(page, "the red sofa")).answer.predicted_id, answer.predicted_id);
  assert.deepEqual(complaints, []);
  await close();
});

test("two things are one: chosen by hand, highlighted together, clicked as one", async () => {
  const { page, complaints, close } = await open("?tab=things");
  await drawn(page);
  const { instances } = await (await fetch(`${service.api}/v1/scenes/${scene.id}/instances?limit=1000`)).json();
  const [a, b] = instances.filter(({ structure, point_count }) => !structure && point_count > 500).slice(-2);
  await row(page, a.id).click({ modifiers: ["Control"] });
  await row(page, b.id).click({ modifiers: ["Shift"] });
  const selected = () => page.evaluate(() => window.unigroundPage.boxes().filter(({ role }) => role === "selected").map(({ instance }) => instance));
  assert.deepEqual((await selected()).sort(), [a.id, b.id].sort());
  const [reply] = await Promise.all([page.waitForResponse(/\/corrections$/), page.getByRole("button", { name: "These are one object" }).click()]);
  const { made } = await reply.json();
  await page.locator(`[data-instance="${made}"]`).waitFor();
  assert.deepEqual(await selected(), [made]);
  await keep(page, "merged");

  // A click on points of what was joined means the whole.
  await page.keyboard.press("Escape");
  await page.getByRole("button", { name: "Whole room" }).click();
  await page.waitForTimeout(600);
  const at = await page.evaluate(findPointOf, { ids: [a.id, b.id], boxes: [a.box, b.box] });
  assert.ok(at, "none of its points is in sight");
  await page.getByRole("button", { name: "← Back to the list" }).click();
  await page.mouse.click(at.x, at.y);
  await page.locator(`[data-instance="${made}"]`).waitFor();

  await undoAll(page);
  await page.locator(`[data-instance="${made}"]`).waitFor({ state: "detached" });
  await row(page, a.id).waitFor();
  assert.deepEqual(complaints, []);
  await close();
});

/** In the page: a place of the window under which a point of one of these lies. */
function findPointOf({ ids, boxes }) {
  for (const { center, size } of boxes) {
    const middle = window.unigroundPage.project(center);
    for (let away = 0; away < 60 * Math.max(...size); away += 3) {
      for (const [dx, dy] of [[0, 1], [1, 0], [0, -1], [-1, 0]]) {
        const at = { x: middle.x + dx * away, y: middle.y + dy * away };
        if (ids.includes(window.unigroundPage.pick(at.x, at.y)?.instance)) return at;
      }
    }
  }
  return null;
}

test("what is not one thing leaves its parts, and a click on it means one of them", async () => {
  const { page, complaints, close } = await open("?tab=things");
  await drawn(page);
  const { instances } = await (await fetch(`${service.api}/v1/scenes/${scene.id}/instances?limit=1000&level=all`)).json();
  const partsOf = ({ id }) => instances.filter(({ level, things }) => level === "part" && things.includes(id));
  const whole = instances.find((one) => one.level === "thing" && !one.structure && !one.dismissed && partsOf(one).length > 1);
  const parts = partsOf(whole).map(({ id }) => id);
  await openThing(page, whole.id);
  await page.getByRole("button", { name: "This is not one object" }).click();
  await row(page, parts[0]).waitFor();
  assert.equal(await row(page, whole.id).count(), 0);
  await page.getByRole("button", { name: "Whole room" }).click();
  await page.waitForTimeout(600);
  const at = await page.evaluate(findPointOf, { ids: [whole.id], boxes: partsOf(whole).map(({ box }) => box) });
  assert.ok(at, "none of its points is in sight");
  await page.mouse.click(at.x, at.y);
  const shown = page.locator("[data-instance]");
  await shown.waitFor();
  assert.ok(parts.includes(Number(await shown.getAttribute("data-instance"))));
  await keep(page, "taken-apart");

  await page.getByRole("button", { name: "← Back to the list" }).click();
  await undoAll(page);
  await row(page, whole.id).waitFor();
  assert.deepEqual(complaints, []);
  await close();
});

test("what has no known parts can not be taken apart, and what to do then is told", async () => {
  const { page, complaints, close } = await open("?tab=things");
  const { instances } = await (await fetch(`${service.api}/v1/scenes/${scene.id}/instances?limit=1000&level=all`)).json();
  const parts = instances.filter(({ level }) => level === "part").flatMap(({ things }) => things);
  const whole = instances.find(({ level, structure, id }) => level === "thing" && !structure && !parts.includes(id));
  await openThing(page, whole.id);
  await page.getByRole("button", { name: "This is not one object" }).click();
  const problem = page.getByRole("alert");
  await problem.waitFor();
  assert.match(await problem.textContent(), /What to do:.*no_parts/s);
  await keep(page, "no-parts");
  assert.deepEqual(complaints, []);
  await close();
});

test("by keyboard alone: one thing and another are gathered, and said to be junk", async () => {
  const { page, complaints, close } = await open("?tab=things");
  await drawn(page);
  const { instances } = await (await fetch(`${service.api}/v1/scenes/${scene.id}/instances?limit=1000`)).json();
  const some = instances.filter(({ structure }) => !structure).slice(-2);
  for (const { id } of some) {
    await row(page, id).focus();
    await page.keyboard.press("Enter");
    await page.getByRole("button", { name: "Add to selection" }).focus();
    await page.keyboard.press("Enter");
    await page.getByRole("button", { name: "← Back to the list" }).focus();
    await page.keyboard.press("Enter");
  }
  await page.getByText("2 objects selected.").waitFor();
  await page.getByRole("button", { name: "Mark all as junk" }).focus();
  await page.keyboard.press("Enter");
  await row(page, some[0].id).waitFor({ state: "detached" });
  await undoAll(page);
  await row(page, some[0].id).waitFor();
  assert.deepEqual(complaints, []);
  await close();
});

test("corrected things are taken home as ground truth", async () => {
  const { page, complaints, close } = await open("?tab=things");
  await page.locator("details.corrections summary").click();
  const [file] = await Promise.all([page.waitForEvent("download"), page.getByRole("button", { name: "Download annotations" }).click()]);
  const { objects } = JSON.parse(await readFile(await file.path(), "utf8"));
  assert.ok(objects.length > 10, `${objects.length} objects`);
  assert.ok(objects.every(({ name, min, max }) => name && min.length === 3 && max.length === 3));
  assert.deepEqual(complaints, []);
  await close();
});
