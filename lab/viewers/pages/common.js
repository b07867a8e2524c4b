// What every page is told and tells: the file and the camera in its address, and in window.viewer
// whether the file is open, why not, and how to draw once more.
const query = new URLSearchParams(location.search);

export const file = query.get('file');
export const kind = file.toLowerCase().match(/(lod-meta\.json|tileset\.json|\.[a-z0-9]+)$/)[1];
// position, target and up in the viewer's world; fov in degrees, across and along the height of a
// square picture; place: latitude, longitude and height of a scene on the globe
export const pose = JSON.parse(query.get('camera'));

export const viewer = (window.viewer = { ready: false, failed: null, draw: () => {} });

export const fail = (error) => {
    viewer.failed ??= String(error?.message ?? error?.reason?.message ?? error?.reason ?? error);
};
addEventListener('error', fail);
addEventListener('unhandledrejection', fail);

// Run what opens the file; it returns how to draw once.
export const show = async (open) => {
    try {
        viewer.draw = await open();
        viewer.ready = true;
    } catch (error) {
        fail(error);
    }
};
