/** The state of an open room, shared by its panels and its 3D view. */

import { computed, signal } from "@preact/signals";
import { asProblem } from "../api/client";
import { allInstances, getAnswer, getModels, getScene, ground } from "../api/service";
import type { Aabb, Answer, Change, GroundRequest, InstanceView, ModelList, Observer, OrientedBox, Problem, Scene } from "../api/types";
import { amend, route } from "../route";
import type { DrawnBox } from "../view3d/boxes";
import type { Point } from "../view3d/marks";
import type { Coloring } from "../view3d/points";
import { Corrections } from "./corrections";
import { nameOf } from "./names";
import { Photographs } from "./photographs";

export type BoxKind = "turned" | "aligned" | "none";
export type Tool = "look" | "measure" | "observer";
export type Tab = "ask" | "why" | "things" | "photos" | "report";

export const TABS: readonly Tab[] = ["ask", "why", "things", "photos", "report"];

/** Where the eyes of an observer are that is placed by a click on the floor. */
export const OBSERVER_HEIGHT_M = 1.5;

/** What a question may be asked with, beside its words. */
export type Options = Required<Pick<GroundRequest, "reasoner" | "top_k" | "direction_convention" | "evidence" | "parser">> & {
  min_confidence: number;
  max_cost_usd: number | null;
};

export class Room {
  readonly scene = signal<Scene | null>(null);
  readonly instances = signal<Map<number, InstanceView>>(new Map());
  readonly models = signal<ModelList | null>(null);
  readonly problem = signal<Problem | null>(null);
  /** Whether the objects of the scene have been fetched. */
  readonly loaded = signal(false);

  /** A question that is asked as soon as the scan is parsed. */
  readonly queued = signal<string | null>(null);
  readonly question = signal("");
  readonly options = signal<Options>({
    reasoner: "auto", top_k: 5, direction_convention: "paper", evidence: "full", parser: "auto", min_confidence: 0.7, max_cost_usd: null,
  });
  readonly observer = signal<Observer | null>(null);
  /** Whether the observer's direction is set as well. */
  readonly observerPlaced = signal(true);
  readonly asking = signal(false);
  readonly answer = signal<Answer | null>(null);
  readonly askProblem = signal<Problem | null>(null);
  readonly showCandidates = signal(false);

  readonly selected = signal<number | null>(null);
  /** Things chosen together, to say something of all of them. */
  readonly group = signal<number[]>([]);
  readonly hovered = signal<number | null>(null);
  readonly coloring = signal<Coloring>("photograph");
  readonly boxKind = signal<BoxKind>("turned");
  readonly cutWalls = signal(true);
  readonly cutHeight = signal(Infinity);
  readonly walking = signal(false);
  readonly tool = signal<Tool>("look");
  readonly ends = signal<Point[]>([]);
  readonly measureFrom = signal<number | null>(null);

  /** Set by the picture: brings a box into the middle. */
  frame: (box: OrientedBox) => void = () => undefined;

  readonly tab = computed<Tab>(() => TABS.find((tab) => tab === route.value.parameters.get("tab")) ?? "ask");
  /** Whether numbers in the answer are those of the list of things. */
  readonly sameParse = computed(() => this.answer.value === null || this.answer.value.parse_version === this.scene.value?.parse_version);
  readonly corrections: Corrections;
  readonly photographs: Photographs;
  readonly boxes = computed<DrawnBox[]>(() => this.drawnBoxes());
  /** Things that stand out: what was chosen by hand, else what the answer means. */
  readonly lit = computed<number[]>(() => {
    const chosen = this.chosen();
    const lit = chosen.length ? chosen : this.sameParse.value ? this.meant() : [];
    return lit.flatMap((id) => this.cutsOf(id));
  });
  /** Ends of the line that is drawn: what was measured by hand, else what the answer measured. */
  readonly measured = computed<Point[]>(() => {
    if (this.ends.value.length || !this.sameParse.value) return this.ends.value;
    return (this.answer.value?.value?.line ?? []) as Point[];
  });
  readonly tinted = computed<number[]>(() => (this.hovered.value === null ? [] : this.cutsOf(this.hovered.value)));

  constructor(readonly id: string) {
    this.photographs = new Photographs(id);
    this.corrections = new Corrections(id, () => this.lookAgain());
  }

  async load(signal: AbortSignal): Promise<void> {
    try {
      void getModels().then((models) => (this.models.value = models)).catch(() => undefined);
      this.queueLinked();
      const scene = await getScene(this.id, signal);
      const ready = scene.status === "ready";
      // The picture of a scene is made for its objects.
      if (ready) await this.lookAgain(signal);
      this.scene.value = scene;
      if (!ready) return;
      this.cutHeight.value = ceilingOf([...this.instances.value.values()]);
      await this.corrections.load();
      await this.reopen();
      this.loaded.value = true;
      await this.askQueued();
    } catch (thrown) {
      if (!signal.aborted) this.problem.value = asProblem(thrown);
    }
  }

  /** What was found, as corrections have left it. */
  private async lookAgain(signal?: AbortSignal): Promise<void> {
    const instances = await allInstances(this.id, signal);
    this.instances.value = new Map(instances.map((instance) => [instance.id, instance]));
    const there = (id: number) => this.instances.value.get(id)?.dismissed === false || this.corrections.junk.value.has(id);
    if (this.selected.value !== null && !there(this.selected.value)) this.select(null);
    this.group.value = this.group.value.filter(there);
  }

  /** Takes a question from the address: `ask=` is asked, `q=` is only shown. */
  private queueLinked(): void {
    const query = route.peek().parameters.get("ask");
    if (!query) return;
    this.question.value = this.queued.value = query;
    amend({ ask: null });
  }

  private async askQueued(): Promise<void> {
    const query = this.queued.peek();
    if (query === null) return;
    this.queued.value = null;
    this.question.value = query;
    await this.ask();
  }

  /** Restores what a link names: question, answer and selected object. */
  private async reopen(): Promise<void> {
    const { parameters } = route.peek();
    const [answer, selected] = [parameters.get("answer"), Number(parameters.get("thing"))];
    this.question.value = parameters.get("q") ?? this.question.peek();
    if (this.instances.value.has(selected)) this.selected.value = selected;
    if (answer) await this.open(answer, parameters.has("cam"));
  }

  async ask(): Promise<void> {
    const query = this.question.value.trim();
    if (!query || this.asking.value) return;
    if (!this.loaded.value) {
      this.queued.value = query;
      return;
    }
    this.asking.value = true;
    this.askProblem.value = null;
    try {
      const answer = await ground(this.id, this.request());
      if (!["ask", "why"].includes(this.tab.peek())) amend({ tab: "ask" });
      this.show(answer);
    } catch (thrown) {
      this.askProblem.value = asProblem(thrown);
    } finally {
      this.asking.value = false;
    }
  }

  /** The request as it is sent, and as it is copied: what is left at its default is left out. */
  request(): GroundRequest {
    const { reasoner, top_k, direction_convention, evidence, parser, min_confidence, max_cost_usd } = this.options.value;
    const request: GroundRequest = { query: this.question.value.trim() };
    if (top_k !== 5) request.top_k = top_k;
    if (reasoner !== "auto") request.reasoner = reasoner;
    if (direction_convention !== "paper") request.direction_convention = direction_convention;
    if (evidence !== "full") request.evidence = evidence;
    if (parser !== "auto") request.parser = parser;
    if (min_confidence !== 0.7) request.min_confidence = min_confidence;
    if (max_cost_usd !== null) request.max_cost_usd = max_cost_usd;
    if (this.observer.value) request.observer = this.observer.value;
    const context = this.context();
    if (context) request.context = context;
    return request;
  }

  /** Context of a follow-up question: the selected thing, and the answer on show. */
  private context(): GroundRequest["context"] {
    const [answer, instance] = [this.sameParse.value ? this.answer.value : null, this.selected.value];
    if (!answer?.stored && instance === null) return null;
    return { ...(answer?.stored ? { answer_id: answer.id } : {}), ...(instance === null ? {} : { instance }) };
  }

  /** An answer that was given before. */
  async open(id: string, stay = false): Promise<void> {
    try {
      const answer = await getAnswer(id);
      this.question.value = answer.query;
      this.show(answer, stay);
    } catch (thrown) {
      this.askProblem.value = asProblem(thrown);
    }
  }

  show(answer: Answer, stay = false): void {
    this.answer.value = answer;
    this.askProblem.value = null;
    this.selected.value = null;
    this.showCandidates.value = answer.status === "ambiguous";
    const boxes = this.answerBoxes().map(({ box }) => box);
    const moves = boxes.length > 0 && !stay;
    if (moves) this.frame(around(boxes));
    amend({ answer: answer.id, q: answer.query, thing: null, ...(moves ? { cam: null } : {}) }, !stay);
  }

  select(id: number | null, look = true): void {
    this.selected.value = id;
    amend({ thing: id === null ? null : String(id) });
    const instance = id === null ? null : this.instances.value.get(id);
    if (instance && look) this.frame(instance.oriented_box);
  }

  /** Chooses a thing beside those that are chosen already, or lets go of it. */
  gather(id: number): void {
    const before = this.group.value;
    const start = before.length || this.selected.value === null || this.selected.value === id ? before : [this.selected.value];
    this.group.value = start.includes(id) ? start.filter((one) => one !== id) : [...start, id];
  }

  /** Says that the parse is wrong, and goes on with what came of it. */
  async correct(change: Change): Promise<void> {
    const made = await this.corrections.make(change);
    if (!made || change.kind === "rename") return;
    this.group.value = [];
    this.select(made.made ?? null, false);
  }

  /**
   * What the number of a point means now: people may have joined what the parse cut, taken it apart, or called it junk.
   * Which part of what was taken apart a point belongs to, only boxes tell.
   */
  standing(cut: number, point?: Point): number | null {
    const instance = this.instances.value.get(cut);
    if (!instance) return null;
    if (this.corrections.split.value.has(cut)) return (point && this.partsOf(instance).find(({ box }) => holds(box, point))?.id) ?? null;
    if (instance.dismissed) return null;
    const whole = this.mergedInto(instance);
    return whole === null ? cut : this.standing(whole);
  }

  /** The box to look at: that of the selected object, else that of the answer. */
  focus(): OrientedBox | null {
    const boxes = this.boxes.peek();
    const ofRole = (role: DrawnBox["role"]) => boxes.filter((box) => box.role === role).map(({ box }) => box);
    const focused = [ofRole("selected"), ofRole("answer")].find((some) => some.length > 0);
    return focused ? around(focused) : null;
  }

  /** Height of the floor, meters. */
  floor(): number {
    const floors = [...this.instances.peek().values()].filter(({ structure }) => structure === "floor");
    const largest = floors.sort((a, b) => b.point_count - a.point_count)[0];
    if (largest) return largest.box.center[2]!;
    const extent = this.scene.peek()?.extent;
    return extent ? extent.center[2]! - extent.size[2]! / 2 : 0;
  }

  /** What a box is called: by people, by the answer (those of long ago name no candidates), else as in the list of things. */
  name(id: number): string {
    const answer = this.answer.value;
    const found = this.sameParse.value ? this.instances.value.get(id) : undefined;
    const told = [...(answer?.targets ?? []), ...(answer?.candidates ?? []), ...(answer?.alternatives ?? [])].find((one) => one.id === id);
    return found?.given_name ?? answer?.answer.candidate_names[id] ?? (told?.name || (found ? nameOf(found) : ""));
  }

  /** Points know the thing only that the parse cut: a part has its thing's, a whole those of all it is made of. */
  private cutsOf(id: number): number[] {
    const instance = this.instances.value.get(id);
    if (!instance) return [id];
    const split = [...this.corrections.split.value].find((thing) => this.partsOf(this.instances.value.get(thing)!).includes(instance));
    if (split !== undefined) return [split];
    if (instance.merged_from?.length) return instance.merged_from.flatMap((member) => this.cutsOf(member));
    return instance.things?.length && this.mergedInto(instance) === null ? instance.things : [id];
  }

  /** The thing that people made of this one and others. */
  private mergedInto({ id, level, things }: InstanceView): number | null {
    const whole = level === "part" ? things?.[0] : undefined;
    return whole !== undefined && this.instances.value.get(whole)?.merged_from?.includes(id) ? whole : null;
  }

  /** What a thing was taken apart into, the smallest first. Its parts are numbered after all things of the parse, and lie in its box. */
  private partsOf({ box }: InstanceView): InstanceView[] {
    const things = this.scene.value?.counts?.instances ?? 0;
    const part = ({ id, dismissed, level, merged_from, found_for, box: own }: InstanceView) =>
      id > things && !dismissed && level === "thing" && !merged_from?.length && !found_for && holds(box, own.center);
    const volume = ({ box: { size } }: InstanceView) => size.reduce((product, length) => product * length, 1);
    return [...this.instances.value.values()].filter(part).sort((a, b) => volume(a) - volume(b));
  }

  /** What was chosen by hand. */
  private chosen(): number[] {
    return [...new Set([...this.group.value, ...(this.selected.value === null ? [] : [this.selected.value])])];
  }

  /** Numbers of what the answer means. */
  private meant(): number[] {
    const answer = this.answer.value;
    if (!answer) return [];
    if (answer.targets?.length) return answer.targets.map(({ id }) => id);
    return answer.answer.predicted_id == null ? [] : [answer.answer.predicted_id];
  }

  private answerBoxes(): DrawnBox[] {
    const answer = this.answer.value;
    if (!answer) return [];
    const drawn = (answer.targets ?? []).map(({ id, box, oriented_box }) => this.drawn(id, "answer", box, oriented_box));
    if (!drawn.length && answer.box) drawn.push(this.drawn(answer.answer.predicted_id ?? 0, "answer", answer.box, answer.oriented_box));
    if (!drawn.length && answer.status === "ambiguous") {
      for (const { id, box, oriented_box } of answer.alternatives) drawn.push(this.drawn(id, "candidate", box, oriented_box));
    }
    return drawn;
  }

  private drawnBoxes(): DrawnBox[] {
    const boxes = this.answerBoxes();
    const add = (id: number | null | undefined, role: DrawnBox["role"]) => {
      const instance = id == null ? undefined : this.instances.value.get(id);
      if (instance && boxes.every((box) => box.instance !== id)) boxes.push(this.drawn(id!, role, instance.box, instance.oriented_box));
    };
    for (const id of this.chosen()) add(id, "selected");
    add(this.hovered.value, "hovered");
    if (this.boxKind.value === "none") return boxes.filter(({ role }) => role === "answer" || role === "selected");
    if (this.sameParse.value) add(this.answer.value?.answer.anchor_id, "anchor");
    if (this.showCandidates.value) {
      for (const { id, box, oriented_box } of this.answer.value?.candidates ?? []) {
        if (boxes.every((drawn) => drawn.instance !== id)) boxes.push(this.drawn(id, "candidate", box, oriented_box));
      }
    }
    return boxes;
  }

  private drawn(instance: number, role: DrawnBox["role"], box: Aabb, turned?: OrientedBox | null): DrawnBox {
    return { instance, role, box: this.boxKind.value !== "aligned" && turned ? turned : { ...box, yaw_rad: 0 } };
  }
}

/** What holds all of these. */
export function around(boxes: OrientedBox[]): OrientedBox {
  if (boxes.length === 1) return boxes[0]!;
  const ends = [0, 1, 2].map((axis) => {
    const sides = boxes.map(({ center, size, yaw_rad }) => {
      const [cos, sin] = [Math.abs(Math.cos(yaw_rad)), Math.abs(Math.sin(yaw_rad))];
      const [dx, dy, dz] = size as [number, number, number];
      const reach = [cos * dx + sin * dy, sin * dx + cos * dy, dz][axis]! / 2;
      return [center[axis]! - reach, center[axis]! + reach] as const;
    });
    return [Math.min(...sides.map(([low]) => low)), Math.max(...sides.map(([, high]) => high))] as const;
  });
  return { center: ends.map(([low, high]) => (low + high) / 2), size: ends.map(([low, high]) => high - low), yaw_rad: 0 };
}

const holds = ({ center, size }: Aabb, point: number[]) => point.every((figure, axis) => Math.abs(figure - center[axis]!) <= size[axis]! / 2);

/** Where the room is cut at first: below its ceiling, where one was scanned. */
function ceilingOf(instances: InstanceView[]): number {
  const ceilings = instances.filter(({ structure }) => structure === "ceiling");
  return Math.min(Infinity, ...ceilings.map(({ box }) => box.center[2]! - box.size[2]! / 2 - 0.05));
}
