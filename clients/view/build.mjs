// Bundles the page into broker/caviar_view/page, or into the folder that is named.
import { copyFile, mkdir, readFile } from "node:fs/promises";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";

const here = dirname(fileURLToPath(import.meta.url));
const out = process.argv[2] ?? join(here, "../../broker/caviar_view/page");

// The bundle is a copy of three.js, whose licence goes with every copy.
const licence = await readFile(join(here, "node_modules/three/LICENSE"), "utf8");

await mkdir(out, { recursive: true });
await build({
  absWorkingDir: here,
  entryPoints: [
    { in: "src/main.ts", out: "viewer" },
    { in: "src/style.css", out: "viewer" },
  ],
  outdir: out,
  bundle: true,
  minify: true,
  format: "esm",
  target: "es2022",
  legalComments: "inline",
  banner: { js: `/*!\n${licence.trim()}\n*/` },
  logLevel: "warning",
});
await copyFile(join(here, "src/index.html"), join(out, "index.html"));
