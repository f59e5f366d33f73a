// What is selected: its taxels, its types, and why nothing of it is seen.

/** Whether a taxel belongs to a row of the tree: (sheet, i) => bool; null without a row. */
export function taxelsOf(row) {
  if (!row) return null;
  const buses = row.driver.patches.map(({ bus }) => bus);
  return (sheet, i) =>
    sheet.driver === row.driver &&
    (row.level < 2 || (row.level === 2 ? buses[sheet.patch[i]] === row.bus : sheet.patch[i] === row.patch));
}

/** Names of the types to choose from: those of the selected row, or of the whole skin. */
export function typesOf(skin, row) {
  const isIn = taxelsOf(row);
  return isIn ? [...row.driver.sheets.values()].filter((sheet) => hasSome(sheet, isIn)).map(({ type }) => type) : skin.types();
}

/** The sheets to draw: of a type, or the first of each driver; in a wipe test those that a touch changes. */
export function sheetsOf(skin, { type, mode }) {
  return skin.shown(type).filter(({ isTouch }) => isTouch || mode !== "wipe");
}

/**
 * Why nothing is seen of what is selected.
 * @param {Skin} skin
 * @param {?object} row that is selected.
 * @param {object} view `type`, `mode`.
 * @param {Sheet[]} sheets that are drawn.
 * @returns {?{text: string, advice: string, command: string}} null if something is seen.
 */
export function whyEmpty(skin, row, { type, mode }, sheets) {
  const isIn = taxelsOf(row) ?? (() => true);
  if (sheets.some((sheet) => hasSome(sheet, isIn))) return null;
  if (!skin.drivers.size) return noDriver(skin);
  const name = row?.name ?? "The skin";
  const types = typesOf(skin, row);
  if (mode === "wipe" && types.some((one) => one === type || !type)) {
    return { text: `${name} has no sensors of touch here: there is nothing to wipe over.`, advice: "1 shows values.", command: "" };
  }
  if (!types.length) return { text: `${name} has no sensors.`, advice: "", command: "" };
  return { text: `${name} has no ${type ?? "sensors of this kind"}.`, advice: `It has ${types.join(", ")}: choose one with t.`, command: "" };
}

function noDriver({ names, namespaces, recordings }) {
  if (recordings.length) return { text: `No driver is recorded at this moment of ${recordings.join(", ")}.`, advice: "", command: "" };
  if (!namespaces.length) return { text: "This recording cannot be shown: the reason is beside.", advice: "", command: "" };
  const [namespace = "default"] = namespaces;
  const who = names.length ? `None of the drivers ${names.join(", ")} runs` : "No driver runs";
  const where = namespace === "default" ? "" : ` --namespace ${namespace}`;
  return {
    text: `${who} in namespace ${namespace}; the skin appears here as soon as one does.`,
    advice: "Without hardware:",
    command: `skin-driver --bus virtual${names.length ? ` --name ${names[0]}` : ""}${where}`,
  };
}

function hasSome(sheet, isIn) {
  for (let i = 0; i < sheet.n; i++) if (isIn(sheet, i)) return true;
  return false;
}
