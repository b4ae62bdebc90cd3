import type { InstanceView } from "../api/types";

/** What a thing is called: by people, by a model, by the encoder. */
export const nameOf = ({ given_name, model_name, label }: InstanceView): string => given_name ?? model_name ?? label;

/** What it would be called had nobody given it a name. */
export const foundAs = ({ model_name, structure, names, label }: InstanceView): string => model_name ?? structure ?? names[0]?.name ?? label;
