// Prints the digest of a log (see hiersched.log.digest), read by @mcap/core by its indexes, and the
// metadata, as JSON.
import { createHash } from "node:crypto";
import { open } from "node:fs/promises";
import { McapIndexedReader } from "@mcap/core";
import { decompress } from "fzstd";

const handle = await open(process.argv[2], "r");
const { size } = await handle.stat();
const readable = {
  size: async () => BigInt(size),
  read: async (offset, length) => {
    const data = new Uint8Array(Number(length));
    await handle.read(data, 0, data.length, Number(offset));
    return data;
  },
};
const decompressHandlers = {
  zstd: (data, full) => decompress(data, new Uint8Array(Number(full))),
};
const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });

const messages = new Map();
for await (const message of reader.readMessages({ validateCrcs: true })) {
  const { topic } = reader.channelsById.get(message.channelId);
  if (!messages.has(topic)) messages.set(topic, []);
  messages.get(topic).push(message);
}
const hash = createHash("sha256");
for (const topic of [...messages.keys()].sort()) {
  hash.update(topic + "\0");
  for (const message of messages.get(topic)) {
    const head = new DataView(new ArrayBuffer(12));
    head.setBigUint64(0, message.logTime, true);
    head.setUint32(8, message.data.byteLength, true);
    hash.update(new Uint8Array(head.buffer));
    hash.update(message.data);
  }
}
const metadata = {};
for await (const record of reader.readMetadata()) {
  metadata[record.name] = Object.fromEntries(record.metadata);
}
const attachments = [];
for await (const { name } of reader.readAttachments({ validateCrcs: true })) attachments.push(name);
console.log(JSON.stringify({ digest: hash.digest("hex"), metadata, attachments }));
