// An independent client of rtec's OPC UA server: browses, subscribes, tries to write, tries to connect without encryption.
// Usage: node opcua_client.js ENDPOINT FOLDER_OF_KEYS; one line of JSON at the end.
const { OPCUAClient, MessageSecurityMode, SecurityPolicy, AttributeIds, DataType, TimestampsToReturn,
  ClientSubscription, ClientMonitoredItem } = require("node-opcua-client");
const { OPCUACertificateManager } = require("node-opcua-certificate-manager");
const fs = require("fs");
const os = require("os");
const path = require("path");

const [endpoint, keys] = process.argv.slice(2);

async function main() {
  const rootFolder = fs.mkdtempSync(path.join(os.tmpdir(), "node-opcua-"));
  const clientCertificateManager = new OPCUACertificateManager({ rootFolder, automaticallyAcceptUnknownCertificate: true });
  await clientCertificateManager.initialize();
  const common = { endpointMustExist: false, connectionStrategy: { maxRetry: 0 }, clientCertificateManager };
  const found = { names: [], ages: [] };
  const client = OPCUAClient.create({ ...common, securityMode: MessageSecurityMode.SignAndEncrypt,
    securityPolicy: SecurityPolicy.Basic256Sha256, certificateFile: path.join(keys, "office.pem"),
    privateKeyFile: path.join(keys, "office.key"), applicationUri: "urn:office", clientName: "office" });
  await client.connect(endpoint);
  const session = await client.createSession();
  const namespaces = await session.readNamespaceArray();
  const ours = namespaces.indexOf("urn:rtec:telemetry:1");
  const browse = async (nodeId, depth) => {
    const result = await session.browse(nodeId);
    for (const reference of result.references || []) {
      if (!reference.isForward || depth > 6 || reference.nodeId.namespace === 0) continue;
      found.names.push(reference.browseName.name);
      await browse(reference.nodeId, depth + 1);
    }
  };
  await browse("ObjectsFolder", 0);
  const node = `ns=${ours};s=Axes.X.applied_um`;
  found.applied = (await session.read({ nodeId: node, attributeId: AttributeIds.Value })).value.value;
  found.unit = (await session.read({ nodeId: `${node}.unit`, attributeId: AttributeIds.Value })).value.value.displayName.text;
  const subscription = ClientSubscription.create(session, { requestedPublishingInterval: 100, requestedLifetimeCount: 1000,
    requestedMaxKeepAliveCount: 10, publishingEnabled: true });
  const item = ClientMonitoredItem.create(subscription, { nodeId: `ns=${ours};s=cycles`, attributeId: AttributeIds.Value },
    { samplingInterval: 100, queueSize: 10 }, TimestampsToReturn.Both);
  await new Promise((resolve) => item.on("changed", (value) => {
    found.ages.push(value.value.value);
    if (found.ages.length >= 10) resolve();
  }));
  const status = await session.write({ nodeId: node, attributeId: AttributeIds.Value,
    value: { value: { dataType: DataType.Double, value: 1 } } }).catch((error) => `Bad: ${error.message}`);
  found.write = typeof status === "string" ? status : status.name;
  await subscription.terminate();
  await session.close();
  await client.disconnect();
  const plain = OPCUAClient.create({ ...common, securityMode: MessageSecurityMode.None, securityPolicy: SecurityPolicy.None });
  try {
    await plain.connect(endpoint);
    await plain.createSession();
    found.plain = "let in";
  } catch (error) {
    found.plain = `refused: ${error.message}`;
  }
  await plain.disconnect().catch(() => {});
  console.log(JSON.stringify(found));
  process.exit(0);
}

main().catch((error) => { console.error(error); process.exit(1); });
