// One turn of the server: a JSON header, and the blobs of bytes that it names as [offset, length].

const PADDING = 8; // blobs begin at multiples of it

/**
 * Take a message apart.
 * @param {ArrayBuffer} message u32 (little endian) length of the header, header, blobs.
 * @returns {{header: object, blob: (where: number[], Kind: Function) => ArrayBufferView}} `blob` gives one of the
 *     blobs as a typed array, without a copy.
 */
export function decode(message) {
  const length = new DataView(message).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(message, 4, length)));
  const first = Math.ceil((4 + length) / PADDING) * PADDING;
  const blob = ([offset, size], Kind) => new Kind(message, first + offset, size / Kind.BYTES_PER_ELEMENT);
  return { header, blob };
}
