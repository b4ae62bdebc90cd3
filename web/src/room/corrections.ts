/** What people said of a parse that is wrong; the service keeps it, and later answers go by it. */

import { signal } from "@preact/signals";
import { asProblem } from "../api/client";
import { listCorrections, makeCorrection, undoCorrection } from "../api/service";
import type { Change, Correction, Problem } from "../api/types";
import { t } from "../text";
import { say } from "../ui/say";

export class Corrections {
  /** Newest first, those that were taken back too. */
  readonly all = signal<Correction[]>([]);
  readonly problem = signal<Problem | null>(null);
  readonly busy = signal(false);

  constructor(
    private readonly scene: string,
    /** Fetches what was changed. */
    private readonly onChanged: () => Promise<void>,
  ) {}

  async load(): Promise<void> {
    await this.attempt(async () => undefined);
  }

  /** Returns the correction, or `null` where it was refused. */
  make(change: Change): Promise<Correction | null> {
    return this.attempt(() => makeCorrection(this.scene, change).then(this.done(t.corrections.kept)));
  }

  undo(id: string): Promise<Correction | null> {
    return this.attempt(() => undoCorrection(this.scene, id).then(this.done(t.corrections.undone)));
  }

  private done(words: string): (made: Correction) => Promise<Correction> {
    return async (made) => {
      await this.onChanged();
      say(words);
      return made;
    };
  }

  private async attempt<T>(work: () => Promise<T>): Promise<T | null> {
    this.busy.value = true;
    this.problem.value = null;
    try {
      const done = await work();
      this.all.value = (await listCorrections(this.scene)).corrections;
      return done;
    } catch (thrown) {
      this.problem.value = asProblem(thrown);
      return null;
    } finally {
      this.busy.value = false;
    }
  }
}
