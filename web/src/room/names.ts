import type { InstanceView } from "../api/types";

/** What a thing is called: by people, by a model, by the encoder. */
export const nameOf = ({ given_name, model_name, label }: InstanceView): string => given_name ?? model_name ?? label;
