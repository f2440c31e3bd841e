// The parts of three.js that replays need, which esbuild bundles into three.bundle.js (MIT licence, three.LICENSE):
//
//   npm install three@0.187.0 esbuild@0.28.2
//   npx esbuild es_service/report/assets/three_parts.js --bundle --minify --format=iife --global-name=THREE \
//     --legal-comments=inline --outfile=es_service/report/assets/three.bundle.js
//
// Run both where node_modules is found from this file, and do not commit node_modules.
export {
  AmbientLight, BoxGeometry, BufferGeometry, CapsuleGeometry, Color, CylinderGeometry, DirectionalLight,
  Float32BufferAttribute, GridHelper, Group, HemisphereLight, Line, LineBasicMaterial, Mesh, MeshLambertMaterial,
  PerspectiveCamera, PlaneGeometry, Quaternion, Scene, SphereGeometry, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
