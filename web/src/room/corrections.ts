/** What people said of a parse that is wrong; the service keeps it, and later answers go by it. */

import { computed, signal } from "@preact/signals";
import { asProblem } from "../api/client";
import { forgetPictures } from "../api/pictures";
import { listCorrections, makeCorrection, undoCorrection } from "../api/service";
import type { Change, Correction, Problem } from "../api/types";
import { t } from "../text";
import { say } from "../ui/say";

export class Corrections {
  /** Newest first, those that were taken back too. */
  readonly all = signal<Correction[]>([]);
  readonly problem = signal<Problem | null>(null);
  readonly busy = signal(false);
  /** Numbers of what somebody said is junk. */
  readonly junk = computed(() => new Set(this.holding().flatMap((change) => (change.kind === "dismiss" ? change.instance_ids : []))));
  /** Numbers of what somebody said is not one thing. */
  readonly split = computed(() => new Set(this.holding().flatMap((change) => (change.kind === "split" ? [change.instance_id] : []))));

  constructor(
    private readonly scene: string,
    /** Fetches what was changed. */
    private readonly onChanged: () => Promise<void>,
  ) {}

  async load(): Promise<void> {
    this.all.value = (await listCorrections(this.scene)).corrections;
  }

  /** Returns the correction, or `null` where it was refused. */
  make(change: Change): Promise<Correction | null> {
    return this.attempt(makeCorrection(this.scene, change), t.corrections.kept);
  }

  undo(id: string): Promise<Correction | null> {
    return this.attempt(undoCorrection(this.scene, id), t.corrections.undone);
  }

  private async attempt(work: Promise<Correction>, words: string): Promise<Correction | null> {
    this.busy.value = true;
    this.problem.value = null;
    try {
      const done = await work;
      await this.load();
      await this.onChanged();
      forgetPictures();
      say(words);
      return done;
    } catch (thrown) {
      this.problem.value = asProblem(thrown);
      return null;
    } finally {
      this.busy.value = false;
    }
  }

  private holding(): Change[] {
    return this.all.value.filter(({ undone_at }) => !undone_at).map(({ change }) => change);
  }
}
