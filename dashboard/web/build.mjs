// Bundles the page into dist/, or (--tests) the pure logic with its tests into build/. The same sources give the same bytes.
import { build } from "esbuild";
import { copyFile, mkdir, readdir, readFile, rm } from "node:fs/promises";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";

const here = dirname(fileURLToPath(import.meta.url));
const at = (...parts) => join(here, ...parts);

async function buildPage() {
  await rm(at("dist"), { recursive: true, force: true });
  await mkdir(at("dist"), { recursive: true });
  const license = (await readFile(at("node_modules/uplot/LICENSE"), "utf8")).trim();
  await build({
    absWorkingDir: here,
    banner: { js: `/*! Contains uPlot:\n${license}\n*/` },
    entryPoints: { app: "src/main.ts" },
    outdir: "dist",
    bundle: true,
    minify: true,
    format: "iife",
    target: ["es2022"],
    charset: "utf8",
    legalComments: "eof",
    logLevel: "warning",
  });
  for (const file of ["index.html", "icon.svg"]) await copyFile(at("src", file), at("dist", file));
}

async function buildTests() {
  const names = (await readdir(at("unit"))).filter((name) => name.endsWith(".test.ts")).sort();
  await rm(at("build"), { recursive: true, force: true });
  await build({
    absWorkingDir: here,
    entryPoints: names.map((name) => join("unit", name)),
    outdir: "build",
    external: ["../mock/*"], // read from where they are: they load files of their own
    outExtension: { ".js": ".mjs" },
    bundle: true,
    platform: "node",
    format: "esm",
    target: ["node20"],
    logLevel: "warning",
  });
}

await (process.argv.includes("--tests") ? buildTests() : buildPage());
