import { defineConfig } from "vite";

// Everything lies under /view/ in both programs.
export default defineConfig({
  base: "/view/",
  build: { outDir: "../dist", emptyOutDir: true, target: "es2022", modulePreload: { polyfill: false }, assetsInlineLimit: 0, chunkSizeWarningLimit: 5000 },
});
