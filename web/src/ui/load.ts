/** Something fetched for as long as a part of the page shows it. */

import { useEffect, useState } from "preact/hooks";
import { asProblem, wasAborted } from "../api/client";
import type { Problem } from "../api/types";

export interface Loaded<T> {
  value: T | null;
  problem: Problem | null;
  again: () => void;
}

export function useLoaded<T>(fetchIt: (signal: AbortSignal) => Promise<T>, on: unknown[]): Loaded<T> {
  const [value, setValue] = useState<T | null>(null);
  const [problem, setProblem] = useState<Problem | null>(null);
  const [turn, setTurn] = useState(0);
  useEffect(() => {
    const stop = new AbortController();
    setProblem(null);
    fetchIt(stop.signal).then(
      (fetched) => !stop.signal.aborted && setValue(() => fetched),
      (thrown) => !stop.signal.aborted && !wasAborted(thrown) && setProblem(asProblem(thrown)),
    );
    return () => stop.abort();
  }, [...on, turn]);
  return { value, problem, again: () => setTurn((n) => n + 1) };
}
