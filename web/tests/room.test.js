// An open room: what is drawn, what is said, and that both are about the same thing.

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { after, before, test } from "node:test";
import { drawn, keep, openPage, startBrowser } from "./support/browser.js";
import { decodePng } from "./support/pixels.js";
import { parsedSample, startService } from "./support/service.js";

const annotated = JSON.parse(readFileSync(new URL("../../examples/living_room.scene.json", import.meta.url)));

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

const room = (query = "") => openPage(browser, `${service.page}/#/scenes/${scene.id}${query}`);

async function ask(page, question) {
  await page.getByLabel("Question").fill(question);
  const before = await page.locator("[data-answer]").getAttribute("data-answer", { timeout: 100 }).catch(() => null);
  await page.keyboard.press("Enter");
  await page.waitForFunction((old) => (document.querySelector("article.answer")?.dataset.answer ?? null) !== old, before);
  return page.getByRole("article", { name: "Answer" });
}

test("the answer's box is drawn around the right thing", async () => {
  const { page, complaints, close } = await room();
  await drawn(page);
  await ask(page, "the mug on the coffee table");
  await page.waitForTimeout(500);

  const boxes = await page.evaluate(() => window.unigroundPage.boxes());
  const [answer] = boxes.filter(({ role }) => role === "answer");
  const [anchor] = boxes.filter(({ role }) => role === "anchor");
  assert.ok(answer && anchor, JSON.stringify(boxes));

  // As somebody annotated it: the orange mug, and no other.
  const mug = annotated.objects.filter(({ name }) => /mug/.test(name)).find((thing) => inside(answer.box.center, thing));
  assert.ok(mug, `no annotated mug at ${answer.box.center}`);

  // The canvas shows it there: under the box's middle lies that instance, and its edges are green.
  const middle = await page.evaluate((point) => window.unigroundPage.project(point), answer.box.center);
  const picked = await page.evaluate(({ x, y }) => window.unigroundPage.pick(x, y), middle);
  assert.equal(picked.instance, answer.instance);
  assert.ok(inside(picked.point, mug, 0.05), `${picked.point}`);
  const shot = decodePng(await keep(page, "answer"));
  const corners = await page.evaluate((points) => points.map((point) => window.unigroundPage.project(point)), cornersOf(answer.box));
  const green = EDGES.filter(([a, b]) => hasGreen(shot, corners[a], corners[b])).length;
  assert.ok(green >= 9, `${green} of 12 edges are seen`);
  // The mug is orange, and keeps its color: nothing is mirrored, nothing painted over.
  const [left, right] = [Math.min(...corners.map(({ x }) => x)), Math.max(...corners.map(({ x }) => x))];
  const across = Array.from({ length: 20 }, (_, i) => shot.at(left + ((i + 0.5) / 20) * (right - left), middle.y));
  const orange = across.filter(([red, green, blue]) => red > 110 && red > green + 30 && green > blue).length;
  assert.ok(orange >= 5, `${orange} of 20 pixels across the box are orange: ${across.map((pixel) => [...pixel])}`);
  assert.deepEqual(complaints, []);
  await close();
});

/** Waits until the camera stands and the address says where: a busy machine flies slowly. */
async function still(page) {
  const place = async () => `${await page.evaluate(() => window.unigroundPage.camera().position)} ${page.url()}`;
  for (let [before, now] = ["", await place()]; before !== now; [before, now] = [now, await place()]) {
    await page.waitForTimeout(800);
  }
}

test("a link opens the same question, thing and view again", async () => {
  const { page, close } = await room();
  await drawn(page);
  await ask(page, "the red sofa");
  await still(page);
  const before = page.url();
  await page.locator("canvas").press("ArrowLeft");
  // On a busy machine the address comes long after the picture.
  await page.waitForURL((url) => url.href !== before);
  await still(page);
  const [link, camera] = [page.url(), await page.evaluate(() => window.unigroundPage.camera().position)];
  assert.match(link, /cam=/);
  const { page: again, complaints, close: closeAgain } = await openPage(browser, link);
  await drawn(again);
  assert.equal(await again.getByLabel("Question").inputValue(), "the red sofa");
  await again.getByRole("article", { name: "Answer" }).waitFor();
  const reopened = await again.evaluate(() => window.unigroundPage.camera().position);
  reopened.forEach((figure, i) => assert.ok(Math.abs(figure - camera[i]) < 0.05, `${reopened} is not ${camera}`));
  assert.deepEqual(complaints, []);
  await close();
  await closeAgain();
});

test("what was not understood stands out, and nothing fitting is no error", async () => {
  const { page, close } = await room();
  let answer = await ask(page, "the zorgly red chair");
  assert.equal(await answer.locator(".word.lost").textContent(), "zorgly");
  answer = await ask(page, "the purple beds");
  await answer.getByText("no match", { exact: true }).waitFor();
  await drawn(page);
  assert.deepEqual(await page.evaluate(() => window.unigroundPage.boxes()), []);
  await page.goBack();
  await page.getByRole("article", { name: "Answer" }).locator(".word.lost").waitFor();
  await close();
});

test("several things, candidates and the six fields", async () => {
  const { page, complaints, close } = await room();
  await drawn(page);
  const answer = await ask(page, "how many mugs are there?");
  await answer.getByText(/There are \d+: /).waitFor();
  const boxes = await page.evaluate(() => window.unigroundPage.boxes().filter(({ role }) => role === "answer").length);
  assert.ok(boxes > 1, `${boxes} boxes`);
  await answer.getByText("Six fields of the paper").click();
  for (const field of ["Predicted id", "Explanation", "Candidate names", "Target name matches", "Anchor id", "Relation used"]) {
    await answer.getByText(field, { exact: true }).waitFor();
  }
  await answer.getByText(/^All candidates \(\d+\)/).click();
  const last = answer.locator("details .line").last();
  await last.click();
  assert.equal(await last.getAttribute("aria-pressed"), "true");
  const selected = await page.evaluate(() => window.unigroundPage.boxes().map(({ role }) => role));
  assert.ok(selected.includes("candidate") || selected.includes("selected"), `${selected}`);
  assert.deepEqual(complaints, []);
  await close();
});

test("a click on a thing names it and shows its photographs", async () => {
  const { page, complaints, close } = await room("?tab=things");
  await drawn(page);
  const sofa = annotated.objects.find(({ name }) => /red sofa|sofa/.test(name));
  const at = await page.evaluate((point) => window.unigroundPage.project(point), middleOf(sofa));
  await page.mouse.move(at.x, at.y);
  await page.locator(".label.of-hovered").waitFor();
  await page.mouse.click(at.x, at.y);
  const details = page.locator("[data-instance]");
  await details.waitFor();
  await details.locator(".crop img").waitFor();
  await keep(page, "thing");
  assert.match(await details.textContent(), /Size.*Colors.*Rests on/s);
  assert.deepEqual(complaints, []);
  await close();
});

test("two points are measured", async () => {
  const { page, close } = await room();
  await drawn(page);
  await page.getByRole("button", { name: "Measure", exact: true }).click();
  const table = annotated.objects.find(({ name }) => /coffee table/.test(name));
  const [a, b] = [[table.min[0] + 0.1, middleOf(table)[1], table.max[2]], [table.max[0] - 0.1, middleOf(table)[1], table.max[2]]];
  for (const point of [a, b]) {
    const at = await page.evaluate((point) => window.unigroundPage.project(point), point);
    await page.mouse.click(at.x, at.y);
  }
  const words = await page.locator(".hint").textContent();
  const meters = Number(/^([\d.]+) m/.exec(words)[1]);
  assert.ok(Math.abs(meters - Math.abs(a[0] - b[0])) < 0.12, `${words} for ${a[0] - b[0]}`);
  await close();
});

test("somebody placed on the floor changes what left means", async () => {
  const { page, close } = await room();
  await drawn(page);
  await page.getByText("Answer options").click();
  await page.getByRole("button", { name: "Place in the room" }).click();
  for (const point of [[0.2, -0.6, 0.02], [0.2, 0.6, 0.02]]) {
    const at = await page.evaluate((point) => window.unigroundPage.project(point), point);
    await page.mouse.click(at.x, at.y);
  }
  const degrees = Number(await page.getByLabel("Looks towards, degrees").inputValue());
  assert.ok(Math.abs(degrees - 90) < 12, `${degrees} degrees`);
  const [request] = await Promise.all([page.waitForRequest(/ground$/), ask(page, "the chair closest to me")]);
  assert.ok(Math.abs(request.postDataJSON().observer.yaw_rad - Math.PI / 2) < 0.2);
  await close();
});

test("why: without a model, what counted", async () => {
  const { page, complaints, close } = await room();
  await ask(page, "the mug on the coffee table");
  await page.getByRole("button", { name: "Why this answer" }).click();
  const why = page.locator(".why");
  await why.getByText("Reasons").waitFor();
  assert.match(await why.textContent(), /choosing the answer.*coffee table.*builtin-3/s);
  await why.locator(".picture img").waitFor();
  await keep(page, "why");
  assert.deepEqual(complaints, []);
  await close();
});

const middleOf = ({ min, max }) => min.map((low, i) => (low + max[i]) / 2);
const inside = (point, { min, max }, more = 0) => point.every((figure, i) => figure >= min[i] - more && figure <= max[i] + more);

function cornersOf({ center, size, yaw_rad }) {
  const corners = [];
  for (const a of [-0.5, 0.5]) for (const b of [-0.5, 0.5]) for (const c of [-0.5, 0.5]) {
    const [x, y] = [a * size[0], b * size[1]];
    const [cos, sin] = [Math.cos(yaw_rad), Math.sin(yaw_rad)];
    corners.push([center[0] + cos * x - sin * y, center[1] + sin * x + cos * y, center[2] + c * size[2]]);
  }
  return corners;
}

const EDGES = [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]];

/** Whether most of the places along an edge are green, or two pixels beside it. */
function hasGreen(shot, a, b) {
  const shares = [0.2, 0.35, 0.5, 0.65, 0.8].map((t) => {
    const [x, y] = [a.x + (b.x - a.x) * t, a.y + (b.y - a.y) * t];
    const around = [-2, 0, 2].flatMap((dx) => [-2, 0, 2].map((dy) => shot.at(x + dx, y + dy)));
    return around.some(([red, green, blue]) => green > red + 25 && green > blue + 25);
  });
  return shares.filter(Boolean).length >= 3;
}
