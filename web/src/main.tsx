import "./style/base.css";
import "./style/parts.css";
import "./style/places.css";
import { render } from "preact";
import { App } from "./app";

render(<App />, document.getElementById("page")!);
