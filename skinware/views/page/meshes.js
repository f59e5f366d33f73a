// Meshes of the robot's links, from the server.

import { STLLoader } from "./vendor/three.min.js";

/**
 * Fetch the meshes of links.
 * @param {{frame: string, mesh: string, pose: number[]}[]} links
 * @param {(text: string) => void} complain called for each that cannot be shown.
 * @returns {Promise<{geometry: object, pose: number[]}[]>}
 */
export async function fetchMeshes(links, complain) {
  const loader = new STLLoader();
  const found = await Promise.all(
    links.map(async ({ frame, mesh, pose }) => {
      try {
        const answer = await fetch(mesh);
        if (!answer.ok) throw new Error(answer.statusText);
        const geometry = loader.parse(await answer.arrayBuffer());
        geometry.computeVertexNormals();
        return { geometry, pose };
      } catch (error) {
        complain(`mesh of ${frame}: ${error.message}`);
        return null;
      }
    }),
  );
  return found.filter(Boolean);
}
